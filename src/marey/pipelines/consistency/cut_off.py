"""Which parts of a person lie outside the images."""

from collections.abc import Iterator, Sequence

import numpy as np

from marey.arrays import Mask
from marey.cameras.camera import Camera
from marey.motion.motion import MEASURED, BodyMotion
from marey.pipelines.verdict import VerdictReason
from marey.wording import listed

LEAST_INSIDE = 0.5
"""Share of the measured frames in which two cameras must have a joint in their images. In eight rendered takes of whole
bodies every joint has 1.0; with the images cut at the hips, knees and ankles have 0.0. Chosen by hand."""
_CAMERAS = 2
"""Number of cameras that determine a place."""


def cut_off_reasons(motion: BodyMotion, cameras: Sequence[Camera]) -> Iterator[VerdictReason]:
    """Name the joints that fewer than two cameras have in their images in most frames.

    Args:
        motion: The motion of a whole body.
        cameras: The cameras that recorded it.

    Yields:
        One reason if there are such joints.
    """
    measured = motion.state == MEASURED
    if not measured.any():
        return
    share = _inside(motion, cameras)[measured].mean(axis=0)
    named = zip(motion.joint_names, share, strict=True)
    outside = [name.replace("_", " ") for name, own in named if own < LEAST_INSIDE]
    if outside:
        yield VerdictReason.limit(
            f"In most frames, at most one camera has these joints in its images: {listed(outside, most=12)}. "
            "What is stated of them, and of the stature, follows from the usual shape and motion of people.",
            "Film the whole body, or name the part that the images show, for example --preset upper.", cause="cut off",
        )  # fmt: skip


def _inside(motion: BodyMotion, cameras: Sequence[Camera]) -> Mask:
    """(F, J) whether two cameras have each joint in their images."""
    seen = np.zeros(motion.joint_centres.shape[:2], int)
    for camera in cameras:
        pixels = camera.project(motion.joint_centres.reshape(-1, 3)).reshape(*seen.shape, 2)
        with np.errstate(invalid="ignore"):
            seen += ((pixels >= -0.5) & (pixels < np.array(camera.size) - 0.5)).all(axis=-1)
    return np.asarray(seen >= _CAMERAS)
