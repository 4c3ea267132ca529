"""Trajectories of surface points, with their velocities and accelerations."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask, fields_of, freeze_fields, frozen
from marey.errors import SettingProblem
from marey.surface.tracks.tracking import Tracks

_SIDE = 2
"""Largest number of frames on each side from which velocity and acceleration are estimated. Chosen by hand."""
_SINGLE = np.float32
"""Precision of the arrays: 1 um at 10 m and 1/4000 px at 4000 px, far below the errors of measurement."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Trajectories:
    """Trajectories of N points over F frames in single precision; the fields are the keys of `trajectories.npz`.

    Raises:
        SettingProblem: The arrays are inconsistent.
    """

    frames: Integers
    """(F,) frame numbers of the video, in ascending order."""
    rate: float
    """Sampling rate [Hz]."""
    position: Floats
    """(F, N, 3) positions in the world [m]; NaN where not measured."""
    velocity: Floats
    """(F, N, 3) velocities [m/s]; NaN without a measured neighbouring frame."""
    acceleration: Floats
    """(F, N, 3) accelerations [m/s2]; NaN with fewer than three consecutive measured frames."""
    covariance: Floats
    """(F, N, 3, 3) covariance of the position [m2]."""
    camera_names: tuple[str, ...]
    """Names of the C cameras."""
    pixels: Floats
    """(F, N, C, 2) pixel of the point in each camera [px]; NaN where it is not visible."""
    removed: Mask
    """(N,) whether a filter removed the entire trajectory; its arrays keep the removed values."""

    def __post_init__(self) -> None:
        freeze_fields(self, "frames", dtype=np.int64)
        object.__setattr__(self, "rate", float(self.rate))
        freeze_fields(self, "removed", dtype=np.bool_)
        object.__setattr__(self, "camera_names", tuple(map(str, self.camera_names)))
        both = (len(self.frames), len(self.removed))
        wanted = {
            "position": (*both, 3), "velocity": (*both, 3), "acceleration": (*both, 3), "covariance": (*both, 3, 3),
            "pixels": (*both, len(self.camera_names), 2),
        }  # fmt: skip
        faults = []
        for name, shape in wanted.items():
            object.__setattr__(self, name, frozen(getattr(self, name), _SINGLE))
            if getattr(self, name).shape != shape:
                faults.append(f"{name} has the shape {getattr(self, name).shape} instead of {shape}")
        if np.any(np.diff(self.frames) <= 0):
            faults.append("the frames are not in ascending order")
        if not self.rate > 0:
            faults.append(f"the rate is {self.rate:g} Hz")
        if faults:
            raise SettingProblem(f"The arrays of trajectories are inconsistent: {'; '.join(faults)}.")

    def __len__(self) -> int:
        """Count the points, including removed ones."""
        return len(self.removed)

    @property
    def measured(self) -> Mask:
        """(F, N) where a point was measured."""
        return np.isfinite(self.position[..., 0])

    @property
    def kept(self) -> Integers:
        """Indices of the trajectories that no filter removed."""
        return np.flatnonzero(~self.removed)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all fields by name."""
        return fields_of(self)


@dataclass(frozen=True, eq=False, kw_only=True)
class Sightings:
    """The points measured in one frame: the part of `Tracks` that is kept after tracking has advanced."""

    frame: int
    count: int
    """Number of points started up to this frame."""
    which: Integers
    """(n,) numbers of the measured points."""
    position: Floats
    """(n, 3) positions [m]."""
    covariance: Floats
    """(n, 3, 3) covariance of the positions [m2]."""
    pixels: Floats
    """(n, C, 2) pixels of the points [px]."""


def sightings_of(tracks: Tracks) -> Sightings:
    """Return the points measured in the tracks' frame."""
    here = tracks.measured
    position, covariance, pixels = (getattr(tracks, name)[here] for name in ("position", "covariance", "pixels"))
    return Sightings(
        frame=tracks.frame,
        count=tracks.started,
        which=tracks.number[here],
        position=position,
        covariance=covariance,
        pixels=pixels,
    )


def gathered(rows: Sequence[Sightings], frames: Integers, *, rate: float, camera_names: Sequence[str]) -> Trajectories:
    """Combine the measured points of all frames to trajectories.

    Args:
        rows: Measured points of some of the frames.
        frames: (F,) all frames of the video; those without measured points stay empty.
        rate: Sampling rate [Hz].
        camera_names: Names of the cameras.

    Returns:
        The trajectories, of which none is removed yet.
    """
    cameras, count = len(camera_names), max((row.count for row in rows), default=0)
    shape = (len(frames), count)
    position, covariance = np.full((*shape, 3), np.nan, _SINGLE), np.full((*shape, 3, 3), np.nan, _SINGLE)
    pixels = np.full((*shape, cameras, 2), np.nan, _SINGLE)
    for row in rows:
        f = int(np.searchsorted(frames, row.frame))
        position[f, row.which], covariance[f, row.which] = row.position, row.covariance
        pixels[f, row.which] = row.pixels
    velocity, acceleration = derivatives(position, rate=rate)
    return Trajectories(
        frames=frames, rate=rate, position=position, velocity=velocity, acceleration=acceleration,
        covariance=covariance, camera_names=tuple(camera_names), pixels=pixels, removed=np.zeros(count, bool),
    )  # fmt: skip


def derivatives(position: Floats, *, rate: float) -> tuple[Floats, Floats]:
    """Differentiate positions by time, from a parabola through up to five consecutive measured frames.

    Args:
        position: (F, N, 3) positions [m]; NaN where not measured.
        rate: Sampling rate [Hz].

    Returns:
        Velocity [m/s] and acceleration [m/s2] (F, N, 3). With two consecutive frames the velocity is their difference
        and there is no acceleration; gaps are never bridged.
    """
    known = np.isfinite(position[..., 0])
    before, after = _run_lengths(known), _run_lengths(known[::-1])[::-1]
    velocity, acceleration = np.full_like(position, np.nan), np.full_like(position, np.nan)
    for left in range(_SIDE + 1):
        for right in range(_SIDE + 1):
            f, n = np.nonzero(known & (before == left) & (after == right))
            if left + right == 0 or not len(f):
                continue
            first, second = _coefficients(left, right)
            steps = range(-left, right + 1)
            around = [position[f + k, n] for k in steps]
            velocity[f, n] = rate * sum(c * x for c, x in zip(first, around, strict=True))
            if second is not None:
                acceleration[f, n] = rate**2 * sum(c * x for c, x in zip(second, around, strict=True))
    return velocity, acceleration


def _run_lengths(known: Mask) -> Integers:
    """Count the consecutive known frames just before each frame, at most half the width of a parabola."""
    count = np.zeros(known.shape, np.int64)
    for f in range(1, len(known)):
        count[f] = np.where(known[f - 1], np.minimum(count[f - 1] + 1, _SIDE), 0)
    return count


def _coefficients(left: int, right: int) -> tuple[Floats, Floats | None]:
    """Return the coefficients of the frames in velocity and acceleration, with one frame as the unit of time."""
    time = np.arange(-left, right + 1, dtype=float)
    powers = np.stack([time**k for k in range(min(len(time), 3))], axis=-1)
    inverse = np.linalg.pinv(powers)
    return inverse[1], 2 * inverse[2] if len(inverse) > 2 else None
