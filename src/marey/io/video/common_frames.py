"""The frames of a take whose cameras have clocks of their own: which picture of each camera belongs to which frame."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np

from marey.arrays import Floats, Image, Integers, freeze_fields
from marey.cameras.clocks import Clocks
from marey.io.video.video import Clip

_ROUNDING = 1e-9
"""Times below this are rounding errors [frames]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CommonFrames:
    """The frames of a take, at a common rate on the clock of the first camera, and the pictures nearest to them."""

    rate: float
    """Frame rate: the lowest one of the cameras [Hz]."""
    pictures: Integers
    """(C, F) number of each camera's picture that belongs to each frame; its first or last one where it has none."""
    late: Floats
    """(C, F) instant of the picture less that of the frame [frames]; within half a frame where the camera has one."""
    complete: tuple[int, int]
    """The first frame of which all cameras have a picture, and the one after the last; equal if there is none."""

    def __post_init__(self) -> None:
        freeze_fields(self, "pictures", dtype=np.int64)
        freeze_fields(self, "late")


def common_frames(
    clocks: Clocks, counts: Sequence[int], rates: Sequence[float], times: Sequence[Floats] | None = None
) -> CommonFrames:
    """Find the pictures of each camera that are nearest to the frames of a take.

    Frame f is the instant f / rate on the clock of the first camera; the last frame is within its video.

    Args:
        clocks: The clocks of C cameras.
        counts: Number of pictures of each camera.
        rates: Frame rate of each camera [Hz].
        times: (F,) times of each camera's pictures in its own video [s]; those of constant rates by default.

    Returns:
        The frames.
    """
    rate = min(rates)
    own_times = [np.arange(count) / own for count, own in zip(counts, rates, strict=True)] if times is None else times
    frames = np.arange(int(own_times[0][-1] * rate + 1e-6) + 1)
    wanted = [clocks.times(c, frames / rate) for c in range(len(counts))]
    pictures = np.array([_nearest(*each) for each in zip(own_times, wanted, strict=True)])
    half = [0.5 / own + _ROUNDING for own in rates]
    inside = [(at >= own[0] - h) & (at <= own[-1] + h) for at, own, h in zip(wanted, own_times, half, strict=True)]
    there = np.flatnonzero(np.all(inside, axis=0))
    late = np.array([clocks.instants(c, own[pictures[c]]) * rate - frames for c, own in enumerate(own_times)])
    # Rounding errors would make pictures of the frame's instant late.
    late = np.where(np.abs(late) < _ROUNDING, 0.0, late)
    complete = (int(there[0]), int(there[-1]) + 1) if len(there) else (0, 0)
    return CommonFrames(rate=rate, pictures=pictures, late=late, complete=complete)


def _nearest(times: Floats, wanted: Floats) -> Integers:
    """Return the number of the picture nearest to each wanted time; its times (F,) are ascending."""
    after = np.clip(np.searchsorted(times, wanted), 1, max(len(times) - 1, 1))
    if len(times) == 1:
        return np.zeros(len(wanted), np.int64)
    return np.where(wanted - times[after - 1] <= times[after] - wanted, after - 1, after).astype(np.int64)


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class SelectedPictures(Clip):
    """Pictures of another clip in a given order, of which some may be missing and others repeated."""

    clip: Clip
    """The other clip."""
    pictures: Integers
    """(F,) number of each picture in the other clip, in ascending order."""
    rate: float | None
    """Frame rate [Hz]."""

    @property
    def path(self) -> Path:  # type: ignore[override]
        """The file of the other clip."""
        return self.clip.path

    @property
    def size(self) -> tuple[int, int]:  # type: ignore[override]
        """Width and height [px]."""
        return self.clip.size

    @property
    def count(self) -> int:  # type: ignore[override]
        """Number of pictures."""
        return len(self.pictures)

    @property
    def paths(self) -> tuple[Path, ...]:
        """All files of the other clip."""
        return self.clip.paths

    def images(self, frames: Iterable[int]) -> Iterator[Image]:
        """Decode images one by one; see `Clip.images`."""
        yield from self.clip.images(int(self.pictures[frame]) for frame in frames)
