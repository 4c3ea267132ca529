"""Cameras whose silhouettes contradict the assumption that pictures of one number show one instant."""

from collections.abc import Sequence
from functools import partial
from typing import Protocol

import numpy as np

from marey.arrays import Mask
from marey.cameras.camera import Camera
from marey.cameras.clocks import Clocks
from marey.cameras.shutter import RollingShutter
from marey.fit.clocks.estimate import ClockEstimate, estimate_clocks
from marey.fit.clocks.signals import tangent_signals
from marey.wording import listed

LEAST_FRAMES = 40
"""Takes with fewer frames are not checked: they seldom determine a clock. Chosen by hand."""
LEAST_OFFSET_FRAMES, LEAST_OFFSET_SD = 0.3, 6.0
"""Cameras disagree if the offset of one of them exceeds this [frames], and this number of its standard deviations. The
estimated offsets of synchronous takes were at most 0.06 frames. Chosen by hand."""


class MaskOfCamera(Protocol):
    """Returns single silhouettes."""

    def __call__(self, frame: int, camera: int) -> Mask:
        """Return the silhouette (height, width) of a frame in one camera, given by its number."""


class ClocksDisagree(Exception):
    """The cameras of a take have clocks of their own, which are known now; the take is to be opened again with them.

    Args:
        clocks: The clocks.
        rate: Frame rate [Hz].
    """

    def __init__(self, clocks: Clocks, rate: float):
        self.clocks = clocks
        pairs = zip(clocks.names[1:], clocks.offset_s[1:], strict=True)
        apart = {name: offset for name, offset in pairs if abs(offset) * rate >= LEAST_OFFSET_FRAMES}
        self.apart = tuple(apart)
        """The cameras that were started later or earlier than the first one."""
        early = [
            f"{name} {abs(offset):.3f} s ({abs(offset) * rate:.2f} frames) {'later' if offset > 0 else 'earlier'}"
            for name, offset in apart.items()
        ]
        super().__init__(
            f"The silhouettes show that the cameras were not started together: {listed(early)} than {clocks.names[0]}. "
            "Their pictures are used at these times. `marey sync` keeps them in sync.json; --sync off ignores them."
        )


def estimated_clocks(
    cameras: Sequence[Camera], frames: Sequence[int], mask_of: MaskOfCamera, *, rate: float,
    shutter: RollingShutter | None = None,
) -> ClockEstimate | None:  # fmt: skip
    """Estimate the clocks of the cameras from their silhouettes.

    Args:
        cameras: C cameras.
        frames: Consecutive frames.
        mask_of: Returns the silhouette of a frame in a camera.
        rate: Frame rate [Hz].
        shutter: The cameras' rolling shutters; None without any.

    Returns:
        The clocks, whose times are counted from the first of the frames; None for a short take.
    """
    if len(frames) < LEAST_FRAMES:
        return None
    masks = [partial(mask_of, camera=c) for c in range(len(cameras))]
    signals = tangent_signals(cameras, [map(own, frames) for own in masks], shutter)
    names = tuple(camera.name for camera in cameras)
    return estimate_clocks(names, [np.arange(len(frames)) / rate] * len(cameras), signals)


def require_common_clock(
    cameras: Sequence[Camera], frames: Sequence[int], mask_of: MaskOfCamera, *, rate: float,
    shutter: RollingShutter | None = None,
) -> str | None:  # fmt: skip
    """Check that the silhouettes of all cameras show the same instants.

    Args:
        cameras: C cameras.
        frames: Consecutive frames.
        mask_of: Returns the silhouette of a frame in a camera.
        rate: Frame rate [Hz].
        shutter: The cameras' rolling shutters; None without any.

    Returns:
        A warning if the cameras contradict each other, but not all of their clocks can be determined; None if nothing
        is wrong, or the motion does not determine the clocks.

    Raises:
        ClocksDisagree: They do not, and their clocks are known.
    """
    found = estimated_clocks(cameras, frames, mask_of, rate=rate, shutter=shutter)
    names = [camera.name for camera in cameras]
    late = [] if found is None else _disagreeing(found, rate)
    if found is None or not late:
        return None
    if found.undetermined:
        unknown = listed(found.undetermined)
        return (
            f"The silhouettes of {listed(late)} seem to show other instants than those of {names[0]}, but the clock of "
            f"{unknown} cannot be determined: joints may be wrong by more than is stated."
        )
    raise ClocksDisagree(of_frame_zero(found.clocks, frames[0] / rate), rate)


def _disagreeing(found: ClockEstimate, rate: float) -> list[str]:
    """Return the cameras whose clocks clearly differ from the first one's."""
    clocks = found.clocks
    limit = np.maximum(LEAST_OFFSET_FRAMES / rate, LEAST_OFFSET_SD * clocks.offset_sd_s)
    return [name for name, far in zip(clocks.names, np.abs(clocks.offset_s) > limit, strict=True) if far]


def of_frame_zero(clocks: Clocks, begin_s: float) -> Clocks:
    """Return clocks whose times are counted from the first frame, from those whose times are counted from another one.

    Args:
        clocks: The clocks.
        begin_s: Time of the other frame [s].
    """
    return Clocks(
        names=clocks.names, offset_s=clocks.offset_s - clocks.drift * begin_s, drift=clocks.drift,
        offset_sd_s=np.hypot(clocks.offset_sd_s, clocks.drift_sd * begin_s), drift_sd=clocks.drift_sd,
    )  # fmt: skip
