"""Trajectories: where points of a surface were over time, and how fast they moved there."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields, frozen
from marey.errors import SettingProblem
from marey.surface.tracks.tracking import Tracks

_SIDE = 2
"""Frames before and after one that say how fast a point moves in it."""
_SINGLE = np.float32
"""A step at ten metres is a micrometre, at four thousand pixels a four-thousandth: far below any error."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Trajectories:
    """Trajectories of N points over F frames in single precision, the keys of `trajectories.npz`.

    Raises:
        SettingProblem: The arrays do not belong together.
    """

    frames: Integers
    """(F,) numbers of the video's frames, rising."""
    rate: float
    """Frames a second [Hz]."""
    position: Floats
    """(F, N, 3) in the world [m]; NaN where not measured."""
    velocity: Floats
    """(F, N, 3) [m/s]; NaN without a measured frame beside."""
    acceleration: Floats
    """(F, N, 3) [m/s2]; NaN with fewer than three measured frames in a row."""
    covariance: Floats
    """(F, N, 3, 3) of the position [m2]."""
    camera_names: tuple[str, ...]
    """The C cameras."""
    pixels: Floats
    """(F, N, C, 2) where each camera shows the point [px]; NaN where it does not."""
    removed: Mask
    """(N,) whether a filter took the trajectory out whole; its arrays keep what was taken out."""

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
            faults.append("frames do not rise")
        if not self.rate > 0:
            faults.append(f"the rate is {self.rate:g} Hz")
        if faults:
            raise SettingProblem(f"Trajectories do not belong together: {'; '.join(faults)}.")

    def __len__(self) -> int:
        """Count the points, removed ones too."""
        return len(self.removed)

    @property
    def measured(self) -> Mask:
        """(F, N) where a point was measured."""
        return np.isfinite(self.position[..., 0])

    @property
    def kept(self) -> Integers:
        """The trajectories that no filter took out."""
        return np.flatnonzero(~self.removed)

    def arrays(self) -> dict[str, np.ndarray]:
        """Give all fields by name."""
        return {field.name: np.asarray(getattr(self, field.name)) for field in fields(self)}


@dataclass(frozen=True, eq=False, kw_only=True)
class Sightings:
    """The points that were measured in one frame: what is left of `Tracks` when tracking has gone on."""

    frame: int
    count: int
    """How many points were ever started until then."""
    which: Integers
    """(n,) the numbers of those that were measured."""
    position: Floats
    """(n, 3) [m]."""
    covariance: Floats
    """(n, 3, 3) [m2]."""
    pixels: Floats
    """(n, C, 2) [px]."""


def sightings_of(tracks: Tracks) -> Sightings:
    """Keep what a frame showed."""
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
    """Put together what the frames showed.

    Args:
        rows: What some of the frames showed.
        frames: (F,) all frames of the video; those without a row stay empty.
        rate: Frames a second [Hz].
        camera_names: The cameras.

    Returns:
        The trajectories; none is removed yet.
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
    """Differentiate positions by time, from a parabola through up to five frames measured in a row.

    Args:
        position: (F, N, 3) [m]; NaN where not measured.
        rate: Frames a second [Hz].

    Returns:
        Velocity [m/s] and acceleration [m/s2] (F, N, 3). With two frames in a row the velocity is their difference
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
    """Count for each frame how many frames just before it are known, up to the side of a parabola."""
    count = np.zeros(known.shape, np.int64)
    for f in range(1, len(known)):
        count[f] = np.where(known[f - 1], np.minimum(count[f - 1] + 1, _SIDE), 0)
    return count


def _coefficients(left: int, right: int) -> tuple[Floats, Floats | None]:
    """Give the coefficients by which frames count in velocity and acceleration, a frame being the unit of time."""
    time = np.arange(-left, right + 1, dtype=float)
    powers = np.stack([time**k for k in range(min(len(time), 3))], axis=-1)
    inverse = np.linalg.pinv(powers)
    return inverse[1], 2 * inverse[2] if len(inverse) > 2 else None
