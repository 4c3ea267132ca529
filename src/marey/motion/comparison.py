"""Comparison of two motions: agreement of angles, points and orientations, with limits of agreement."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.errors import MareyError
from marey.geometry import rotations
from marey.geometry.continuity import continuous_angles
from marey.motion.alignment import Alignment, align, common_time
from marey.motion.device_clock import DeviceClock, clock_from_signals
from marey.motion.recording import Recording

_WITHIN = 1.96
"""Standard deviations of a normal distribution that contain 95 % of its values."""
_FEWEST_FOR_CORRELATION = 3
"""Fewest frames from which a correlation is computed."""
ROTATION, WITHOUT_MEAN = " rotation", " rotation without mean"
"""What follows the name of a segment in the names of its two rows."""


class NoCommonTime(MareyError):
    """Two motions without an instant in common."""


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """The agreement of one quantity of two motions; differences are first minus second. NaN where undefined."""

    name: str
    """Name of the quantity: an angle, a point's coordinate, a segment's rotation."""
    kind: str
    """`angle` [rad], `position` [m], `distance` [m] or `rotation` [rad]."""
    frames: int
    """Number of frames in which both values are known."""
    rms: float
    """Root mean square difference."""
    bias: float
    """Mean difference."""
    sd: float
    """Standard deviation of the differences about the bias."""
    correlation: float
    """Pearson's correlation coefficient."""
    within_stated: float = np.nan
    """Share of the differences within 1.96 combined standard deviations of the two motions."""

    @property
    def unit(self) -> str:
        """Unit of the figures: rad or m."""
        return "rad" if self.kind in ("angle", "rotation") else "m"

    @property
    def limits(self) -> tuple[float, float]:
        """The limits of agreement, which contain 95 % of normally distributed differences ([BlandAltman1986])."""
        return self.bias - _WITHIN * self.sd, self.bias + _WITHIN * self.sd


@dataclass(frozen=True, kw_only=True)
class KindAgreement:
    """The agreement of all quantities of one kind together."""

    kind: str
    """`angles`, `points` or `orientations`."""
    count: int
    """Number of quantities."""
    rms: float
    """Root mean square of their root mean square differences [rad or m]; of orientations without the constant offset of
    each segment."""
    correlation: float
    """Correlation of all together, of which those that move more count more; NaN if nothing moves. Orientations are
    compared by the elements of their matrices."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MotionComparison:
    """Two motions at the same times in the same laboratory, and their agreement."""

    alignment: Alignment
    time: Floats
    """(N,) times on the first motion's clock [s]."""
    first: Recording
    """The first motion at these times, reduced to the common quantities."""
    second: Recording
    """The second motion, transformed into the first one's clock and laboratory."""
    agreements: tuple[Agreement, ...]
    only_first: tuple[str, ...] = ()
    """Quantities missing from the second motion."""
    only_second: tuple[str, ...] = ()
    """Quantities missing from the first motion."""
    clock: DeviceClock | None = None
    """The second motion's clock against the first's, if its rate was estimated too; the alignment's shift is then that
    in the middle of the common time."""
    segment_offset: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """(S, 3) constant rotation vector from the first to the second frame of each segment [rad]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "time", "segment_offset")

    @property
    def compared_frames(self) -> tuple[int, int]:
        """Fewest and most frames in which a quantity is known in both motions; quantities without any do not count."""
        counts = [row.frames for row in self.agreements if row.frames]
        return min(counts), max(counts)

    @property
    def together(self) -> tuple[KindAgreement, ...]:
        """Agreement of all angles, of all points and of all orientations that are known in both motions."""
        found = []
        for kind, (first, second) in self._values().items():
            rows = [row for row in self.agreements if row.frames and _is_of(row, kind)]
            if rows:
                rms = float(np.sqrt(np.mean([row.rms**2 for row in rows])))
                correlation = pooled_correlation(first, second)
                found.append(KindAgreement(kind=kind, count=len(rows), rms=rms, correlation=correlation))
        return tuple(found)

    def _values(self) -> dict[str, tuple[Floats, Floats]]:
        """Return the values (N, K) of both motions by kind; orientations without the segments' constant offsets."""
        own, other, frames = self.first, self.second, len(self.time)
        turned = other.rotation @ np.swapaxes(rotations.exp(self.segment_offset), -1, -2)
        return {
            "angles": (own.angles, other.angles),
            "points": (own.points.reshape(frames, -1), other.points.reshape(frames, -1)),
            "orientations": (own.rotation.reshape(frames, -1), turned.reshape(frames, -1)),
        }


def _is_of(row: Agreement, kind: str) -> bool:
    """Return whether a row counts where all quantities of a kind are taken together."""
    if kind == "orientations":
        return row.kind == "rotation" and row.name.endswith(WITHOUT_MEAN)
    return row.kind == {"angles": "angle", "points": "distance"}[kind]


def pooled_correlation(first: Floats, second: Floats) -> float:
    """Return the correlation of several quantities together, of which those that move more count more.

    Args:
        first: (N, K) quantities of one unit; NaN where unknown.
        second: The same of another recording.

    Returns:
        From -1 to 1; NaN if nothing moves.
    """
    known = np.isfinite(first) & np.isfinite(second)
    count = np.maximum(known.sum(0), 1)
    own, other = (np.where(known, each, 0.0) for each in (first, second))
    own, other = (np.where(known, each - each.sum(0) / count, 0.0) for each in (own, other))
    size = np.sqrt((own**2).sum() * (other**2).sum())
    return float((own * other).sum() / size) if size > 0 else float("nan")


def compare(
    first: Recording, second: Recording, *, shift_s: float | None = None, same_laboratory: bool = False,
    free_rate: bool = False, by_angles: bool = True,
) -> MotionComparison:  # fmt: skip
    """Compare the quantities of two recordings that have the same names.

    The shift of the clocks and the rigid offset of the laboratories are removed first, as in section 3 of
    [Rosenhahn2006]. The recordings are compared at the frames of the slower one; the other one is interpolated.

    Args:
        first: A motion.
        second: Another motion; quantities with the same name are compared.
        shift_s: Shift of the second clock [s]; None to estimate it.
        same_laboratory: True if both motions are in the same laboratory frame.
        free_rate: Estimate the rate of the second clock too, from common angles and distances between points.
        by_angles: Use the angles to estimate the shift; otherwise the points and orientations alone. It has no effect
            with `free_rate`.

    Returns:
        The aligned motions and their agreement.

    Raises:
        MareyError: They have no quantity or no time in common.
    """
    names = _common_names(first, second)
    if not any(names.values()):
        raise MareyError("The two motions have no angle, point or segment of the same name.")
    own, other = first.chosen(**names), second.chosen(**names)
    if free_rate:
        clock = _clock(own, other)
        moved = compare(
            own, replace(other, time=clock.instants(other.time)), shift_s=0.0, same_laboratory=same_laboratory
        )
        device = clock.times(moved.time[[0, -1]].mean())
        shift = float(device - moved.time[[0, -1]].mean())
        alignment = replace(moved.alignment, shift_s=shift, shift_sd_s=float(clock.instants_sd(device)))
        return replace(
            moved, alignment=alignment, clock=clock, only_first=_missing_names(first, own),
            only_second=_missing_names(second, other),
        )  # fmt: skip
    used = names if by_angles else names | {"angles": ()}
    alignment = align(
        own.chosen(**used), other.chosen(**used), shift_s=shift_s, same_laboratory=same_laboratory
    )  # fmt: skip
    time = common_time(own.time, other.time, alignment.shift_s)
    if not len(time):
        raise NoCommonTime(f"The two motions have no time in common at a shift of {alignment.shift_s:.3f} s.")
    a = own.at(time)
    b = _aligned(other.at(time + alignment.shift_s), time, a, alignment)
    turns, offsets = _turns(a, b)
    agreements = [*_angles(a, b), *_points(a, b), *turns]
    if not any(row.frames for row in agreements):
        raise MareyError("The two motions have no common frame in which both are known.")
    return MotionComparison(
        alignment=alignment, time=time, first=a, second=b, agreements=tuple(agreements),
        only_first=_missing_names(first, own), only_second=_missing_names(second, other), segment_offset=offsets,
    )  # fmt: skip


def _clock(first: Recording, second: Recording) -> DeviceClock:
    """Estimate the second clock from angles and distances from the points' mean, which hold in any laboratory."""
    own, other = (np.concatenate([continuous_angles(r.angles), _distances(r)], 1) for r in (first, second))
    known = np.isfinite(own).any(0) & np.isfinite(other).any(0)
    if not known.any():
        raise MareyError("The rate of the clock needs common angles, or two common points.")
    return clock_from_signals((first.time, own[:, known]), (second.time, other[:, known]))


def _distances(recording: Recording) -> Floats:
    """Return the distances (F, P) [m] of the points from their mean in frames in which all of them are known."""
    points = recording.points
    if points.shape[1] < 2:
        return np.zeros((len(recording), 0))
    return np.asarray(np.linalg.norm(points - points.mean(1, keepdims=True), axis=-1))


def _common_names(first: Recording, second: Recording) -> dict[str, tuple[str, ...]]:
    kinds = ("angle", "point", "segment")
    lists = {f"{kind}s": (getattr(first, f"{kind}_names"), getattr(second, f"{kind}_names")) for kind in kinds}
    return {key: tuple(name for name in a if name in b) for key, (a, b) in lists.items()}


def _missing_names(whole: Recording, used: Recording) -> tuple[str, ...]:
    kinds = ("angle_names", "point_names", "segment_names")
    left = [name for kind in kinds for name in getattr(whole, kind) if name not in getattr(used, kind)]
    return tuple(dict.fromkeys(left))


def _aligned(second: Recording, time: Floats, first: Recording, alignment: Alignment) -> Recording:
    """Transform the second recording into the first one's laboratory, and its angles into the same period."""
    to_first = alignment.first_from_second
    return Recording(
        time=time,
        angle_names=second.angle_names, angles=_same_turn(second.angles, first.angles), angles_sd=second.angles_sd,
        point_names=second.point_names, points=to_first.apply(second.points),
        segment_names=second.segment_names, rotation=to_first.rotation @ second.rotation,
    )  # fmt: skip


def _same_turn(angles: Floats, like: Floats) -> Floats:
    """Add multiples of 360 degrees to each angle so that it is closest to another one on average."""
    difference = np.where(np.isfinite(angles - like), angles - like, 0.0)
    counts = np.maximum(np.isfinite(angles - like).sum(0), 1)
    return np.asarray(angles - 2 * np.pi * np.round(difference.sum(0) / counts / (2 * np.pi)))


def agreement(name: str, kind: str, first: Floats, second: Floats, sd: Floats | None = None) -> Agreement:
    """Compare one quantity (N,) of two motions.

    Args:
        name: Name of the quantity.
        kind: Kind of the quantity, as in `Agreement.kind`.
        first: (N,) values of the first motion; NaN where unknown.
        second: (N,) values of the second motion; NaN where unknown.
        sd: (N,) standard deviation of the difference; NaN where unknown.

    Returns:
        The agreement.
    """
    known = np.isfinite(first) & np.isfinite(second)
    a, b = first[known], second[known]
    if not len(a):
        return Agreement(name=name, kind=kind, frames=0, rms=np.nan, bias=np.nan, sd=np.nan, correlation=np.nan)
    difference = a - b
    stated = np.full(len(a), np.nan) if sd is None else sd[known]
    with_sd = np.isfinite(stated)
    return Agreement(
        name=name, kind=kind, frames=len(a), rms=float(np.sqrt(np.mean(difference**2))), bias=float(difference.mean()),
        sd=float(difference.std(ddof=1)) if len(a) > 1 else np.nan, correlation=_correlation(a, b),
        within_stated=float(np.mean(np.abs(difference[with_sd]) <= _WITHIN * stated[with_sd])) if with_sd.any() else
        np.nan,
    )  # fmt: skip


def _correlation(a: Floats, b: Floats) -> float:
    if len(a) < _FEWEST_FOR_CORRELATION or a.std() < 1e-9 or b.std() < 1e-9:
        return np.nan
    return float(np.corrcoef(a, b)[0, 1])


def _angles(a: Recording, b: Recording) -> list[Agreement]:
    variance = np.where(np.isfinite(a.angles_sd), a.angles_sd**2, 0) + np.where(
        np.isfinite(b.angles_sd), b.angles_sd**2, 0
    )
    sd = np.where(np.isfinite(a.angles_sd) | np.isfinite(b.angles_sd), np.sqrt(variance), np.nan)
    return [
        agreement(name, "angle", a.angles[:, k], b.angles[:, k], sd[:, k]) for k, name in enumerate(a.angle_names)
    ]  # fmt: skip


def _points(a: Recording, b: Recording) -> list[Agreement]:
    rows = []
    for k, name in enumerate(a.point_names):
        p, q = a.points[:, k], b.points[:, k]
        apart = np.linalg.norm(p - q, axis=-1)
        row = agreement(f"{name} distance", "distance", apart, np.zeros(len(apart)))
        rows.append(row)
        rows += [agreement(f"{name} {axis}", "position", p[:, i], q[:, i]) for i, axis in enumerate("xyz")]
    return rows


def _turns(a: Recording, b: Recording) -> tuple[list[Agreement], Floats]:
    """Compare orientations: the angle between them before and after removal of a constant offset per segment."""
    rows, offsets = [], []
    for k, name in enumerate(a.segment_names):
        between = np.swapaxes(a.rotation[:, k], -1, -2) @ b.rotation[:, k]
        known = np.asarray(np.isfinite(between).all((-1, -2)))
        angle, steady = np.full(len(known), np.nan), np.full(len(known), np.nan)
        offset = np.full(3, np.nan)
        if known.any():
            constant = rotations.mean(between[known])
            offset = rotations.log(constant)
            angle[known] = np.linalg.norm(rotations.log(between[known]), axis=-1)
            steady[known] = np.linalg.norm(rotations.log(constant.T @ between[known]), axis=-1)
        rows.append(agreement(f"{name}{ROTATION}", "rotation", angle, np.zeros(len(angle))))
        rows.append(agreement(f"{name}{WITHOUT_MEAN}", "rotation", steady, np.zeros(len(angle))))
        offsets.append(offset)
    return rows, np.array(offsets).reshape(-1, 3)


def worst(agreements: Sequence[Agreement], kind: str) -> Agreement | None:
    """Return the quantity of a kind with the largest difference, or None if there is none."""
    known = [row for row in agreements if row.kind == kind and np.isfinite(row.rms)]
    return max(known, key=lambda row: row.rms) if known else None
