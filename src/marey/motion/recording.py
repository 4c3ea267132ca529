"""Recordings of a motion from any source: angles, points and orientations over time."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.interpolate import CubicSpline

from marey.arrays import Floats, freeze_fields, frozen, true_runs
from marey.errors import MareyError
from marey.geometry import rotations
from marey.geometry.continuity import continuous_angles

_FEWEST_FOR_CUBIC = 4
"""Fewest samples of a cubic spline; shorter runs are interpolated linearly."""
_TIME_TOLERANCE_S = 1e-6
"""Tolerance of times [s]; times in files have six decimals."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """A motion from this or another program; NaN where unknown."""

    time: Floats
    """(F,) increasing times [s]."""
    angle_names: tuple[str, ...] = ()
    """A names."""
    angles: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """(F, A) angles [rad]."""
    angles_sd: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """(F, A) standard deviations [rad]; NaN where unknown."""
    point_names: tuple[str, ...] = ()
    """P names of joint centres, markers or origins of bones."""
    points: Floats = field(default_factory=lambda: np.zeros((0, 0, 3)))
    """(F, P, 3) positions [m]."""
    segment_names: tuple[str, ...] = ()
    """S names."""
    rotation: Floats = field(default_factory=lambda: np.zeros((0, 0, 3, 3)))
    """(F, S, 3, 3) laboratory from segment."""

    def __post_init__(self) -> None:
        freeze_fields(self, "time")
        frames = len(self.time)
        if frames > 1 and not (np.diff(self.time) > 0).all():
            raise MareyError("The times of a motion are not increasing.")
        shapes = {
            "angles": (frames, len(self.angle_names)), "angles_sd": (frames, len(self.angle_names)),
            "points": (frames, len(self.point_names), 3), "rotation": (frames, len(self.segment_names), 3, 3),
        }  # fmt: skip
        for name, shape in shapes.items():
            values = np.asarray(getattr(self, name), float)
            # Arrays that were not given are empty, or NaN if there are names.
            values = np.full(shape, np.nan) if values.size == 0 else values
            if values.shape != shape:
                raise MareyError(f"The {name} of a motion have the shape {values.shape}; it should be {shape}.")
            object.__setattr__(self, name, frozen(values))

    def __len__(self) -> int:
        return len(self.time)

    @property
    def rate(self) -> float:
        """Frames per second [Hz], from the median time step."""
        return float(1 / np.median(np.diff(self.time))) if len(self) > 1 else np.nan

    def chosen(self, *, angles: Sequence[str], points: Sequence[str], segments: Sequence[str]) -> "Recording":
        """Return some of the angles, points and segments, in the given order."""
        a = [self.angle_names.index(name) for name in angles]
        p = [self.point_names.index(name) for name in points]
        s = [self.segment_names.index(name) for name in segments]
        return replace(
            self, angle_names=tuple(angles), angles=self.angles[:, a], angles_sd=self.angles_sd[:, a],
            point_names=tuple(points), points=self.points[:, p], segment_names=tuple(segments),
            rotation=self.rotation[:, s],
        )  # fmt: skip

    def at(self, time: Floats) -> "Recording":
        """Interpolate the motion at times (N,) [s] by cubic splines; NaN across gaps and beyond the ends."""
        return Recording(
            time=time,
            angle_names=self.angle_names,
            angles=interpolated(self.time, continuous_angles(self.angles), time),
            angles_sd=interpolated(self.time, self.angles_sd, time, cubic=False),
            point_names=self.point_names,
            points=interpolated(self.time, self.points, time),
            segment_names=self.segment_names,
            rotation=_interpolated_rotations(self.time, self.rotation, time),
        )


def interpolated(time: Floats, values: Floats, at: Floats, *, cubic: bool = True, derivative: int = 0) -> Floats:
    """Interpolate values between their frames.

    Each run of known values has its own cubic spline (a linear one if it has fewer than four frames).

    Args:
        time: (F,) time of each frame [s].
        values: (F, ...); NaN where unknown.
        at: (N,) times [s].
        cubic: False for linear interpolation, which never overshoots.
        derivative: 1 for the derivative by time.

    Returns:
        (N, ...); NaN between runs and beyond the ends.
    """
    columns = np.asarray(values, float).reshape(len(time), -1)
    result = np.full((len(at), columns.shape[1]), np.nan)
    known = np.isfinite(columns)
    # Columns with the same gaps are interpolated together.
    groups: dict[bytes, list[int]] = {}
    for column, pattern in enumerate(np.packbits(known, axis=0).T):
        groups.setdefault(pattern.tobytes(), []).append(column)
    for members in groups.values():
        for start, end in true_runs(known[:, members[0]]):
            inside = (at >= time[start] - _TIME_TOLERANCE_S) & (at <= time[end - 1] + _TIME_TOLERANCE_S)
            if inside.any():
                run = slice(start, end)
                interpolate = _interpolator(time[run], columns[run][:, members], cubic=cubic, derivative=derivative)
                result[np.ix_(inside, members)] = interpolate(np.clip(at[inside], time[start], time[end - 1]))
    return result.reshape(len(at), *np.shape(values)[1:])


def _interpolator(time: Floats, values: Floats, *, cubic: bool, derivative: int) -> Callable[[Floats], Floats]:
    if cubic and len(time) >= _FEWEST_FOR_CUBIC:
        spline = CubicSpline(time, values)
        return lambda at: np.asarray(spline(at, derivative))
    if len(time) == 1:
        return lambda at: np.repeat(values if derivative == 0 else np.full_like(values, np.nan), len(at), 0)
    slope = np.diff(values, axis=0) / np.diff(time)[:, None]

    def straight(at: Floats) -> Floats:
        piece = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(slope) - 1)
        if derivative:
            return np.asarray(slope[piece])
        return np.asarray(values[piece] + slope[piece] * (at - time[piece])[:, None])

    return straight


def _interpolated_rotations(time: Floats, rotation: Floats, at: Floats) -> Floats:
    """Interpolate rotations (F, S, 3, 3) by splines of their quaternions."""
    quaternions = rotations.to_quaternion(rotation)
    for s in range(quaternions.shape[1]):
        known = np.isfinite(quaternions[:, s]).all(-1)
        if known.any():
            quaternions[known, s] = rotations.continuous(quaternions[known, s])
    quaternions_at = interpolated(time, quaternions, at)
    known = np.isfinite(quaternions_at).all(-1)
    result = np.full((*quaternions_at.shape[:2], 3, 3), np.nan)
    result[known] = rotations.from_quaternion(quaternions_at[known])
    return result
