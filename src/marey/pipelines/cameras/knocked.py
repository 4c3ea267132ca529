"""A camera whose silhouettes contradict those of the others, because it was moved after its calibration."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.cameras.parameters import pose_basis
from marey.cameras.rig import Rig
from marey.fit.cameras.frontier import FoundCamera, SilhouetteHulls, find_camera, pair_sizes, tangent_differences
from marey.geometry import rotations
from marey.pipelines.clocks.disagreement import MaskOfCamera

LEAST_CAMERAS = 3
"""Number of cameras from which on one can contradict the others."""
LEAST_INSPECTED_FRAMES = 20
"""Takes with fewer frames are not checked: they seldom determine a camera. Chosen by hand."""
MOST_INSPECTED_FRAMES = 400
"""Number of frames of a longer take that are used, evenly spaced. Chosen by hand."""
CONTRADICTION_RAD = 6e-3
"""Median difference of the tangents of two cameras above which they contradict each other [rad]: 4.3 px in images of
640 px. With the first silhouettes of four rendered takes the largest is 4.5e-3; a camera that is turned by 3 degrees
and shifted by 50 mm reaches 1.0e-2 and more."""
SMALLER = 0.4
"""Ratio by which the differences are smaller without the knocked camera, and with it in its new place: 0.22 or less for
knocked cameras of `walk`, `stealth` and `reach` with final silhouettes, and of `jacks` with first ones. Chosen on these
takes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class KnockedCamera:
    """The camera that contradicts the others, found again by its silhouettes."""

    number: int
    found: FoundCamera
    contradiction_px: float
    """Median difference of its tangents from those of another camera [px]."""


class CameraKnocked(Exception):
    """A camera was moved after its calibration, and was found again; the take is to be opened again with it.

    Args:
        rig: The cameras of the calibration.
        knocked: The camera.
    """

    def __init__(self, rig: Rig, knocked: KnockedCamera):
        self.before = rig.cameras[knocked.number]
        after = replace(self.before, camera_from_world=knocked.found.camera.camera_from_world)
        self.rig = Rig(tuple(after if camera is self.before else camera for camera in rig))
        super().__init__(
            f"The silhouettes of {self.before.name} contradict those of the other cameras, which agree, by up to "
            f"{knocked.contradiction_px:.0f} px: it is found again by them."
        )


def find_knocked(cameras: Sequence[Camera], frames: Sequence[int], mask_of: MaskOfCamera) -> KnockedCamera | None:
    """Find the camera again whose silhouettes contradict those of all others, which agree.

    Args:
        cameras: C cameras.
        frames: Frames that show a person.
        mask_of: Returns the silhouette of a frame in a camera.

    Returns:
        The camera; None if there is none or more than one, or with fewer than three cameras, whose contradictions have
        no place.
    """
    if len(cameras) < LEAST_CAMERAS or len(frames) < LEAST_INSPECTED_FRAMES:
        return None
    hulls, pairs = _hulls(cameras, frames, mask_of), list(combinations(range(len(cameras)), 2))
    candidates = _candidates(cameras, hulls, pairs, _sizes(cameras, hulls, pairs))
    return candidates[0] if len(candidates) == 1 else None


def _hulls(cameras: Sequence[Camera], frames: Sequence[int], mask_of: MaskOfCamera) -> list[SilhouetteHulls]:
    index = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), MOST_INSPECTED_FRAMES)).astype(int))
    used = [frames[i] for i in index]
    return [SilhouetteHulls.of(camera, map(partial(mask_of, camera=c), used)) for c, camera in enumerate(cameras)]


def _sizes(cameras: Sequence[Camera], hulls: Sequence[SilhouetteHulls], pairs: Sequence[tuple[int, int]]) -> Floats:
    """Return the median differences (P,) of the tangents of pairs of cameras [rad]; NaN where they are not known."""
    per_pixel = np.array([np.hypot(hulls[i].turn_per_pixel, hulls[j].turn_per_pixel) for i, j in pairs]) / np.sqrt(2)
    return np.asarray(pair_sizes(tangent_differences(cameras, hulls, pairs)) * per_pixel)


def _candidates(
    cameras: Sequence[Camera], hulls: Sequence[SilhouetteHulls], pairs: Sequence[tuple[int, int]], sizes: Floats
) -> list[KnockedCamera]:
    """Return the cameras each of which, at another place, agrees with all others, which agree without it."""
    found = []
    for c in range(len(cameras)):
        own = np.array([c in pair for pair in pairs])
        others, contradiction = np.nan_to_num(sizes[~own]), np.nan_to_num(sizes[own]).max()
        if contradiction <= CONTRADICTION_RAD or others.max() > SMALLER * contradiction:
            continue
        again = find_camera(cameras, hulls, c)
        after = _sizes([again.camera if k == c else camera for k, camera in enumerate(cameras)], hulls, pairs)
        left = float(np.nan_to_num(after).max())
        if left <= SMALLER * contradiction:
            pixels = contradiction / hulls[c].turn_per_pixel
            found.append(KnockedCamera(number=c, found=again, contradiction_px=float(pixels)))
    return found


def displacement(before: Camera, after: Camera) -> tuple[float, float]:
    """Return by how much a camera was turned [deg] and shifted [mm]."""
    turn = rotations.log(after.camera_from_world.rotation @ before.camera_from_world.rotation.T)
    return float(np.degrees(np.linalg.norm(turn))), float(1e3 * np.linalg.norm(after.centre - before.centre))


UNDETERMINED_DEG, UNDETERMINED_MM = 0.5, 40.0
"""Standard deviations of a camera's orientation and position above which the take does not determine it. Chosen by
hand."""


def displacement_sd(camera: Camera, covariance: Floats) -> tuple[float, float]:
    """Return the standard deviations of a camera's turn [deg] and shift [mm] from the covariance of its parameters.

    Args:
        camera: The camera.
        covariance: (15, 15) in the order of `marey.cameras.parameters.PARAMETER_NAMES`.

    Returns:
        The roots of the traces of the covariances of orientation and centre.
    """
    inverse = np.linalg.pinv(pose_basis(camera))
    own = inverse @ covariance @ inverse.T
    return float(np.degrees(np.sqrt(np.trace(own[:3, :3])))), float(1e3 * np.sqrt(np.trace(own[3:, 3:])))
