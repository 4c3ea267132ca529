"""Faults of tracks that a change undoes: missing places written as zeros, frames in a wrong order, exchanged tracks."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from marey.arrays import Floats, Integers, Mask

_CHANGED_FRAMES = 20
"""Largest number of frames that are put in another place one by one; more are a disorder that nothing explains."""

ALL_BY_NAME = -1
"""Count of a fault in which all frames are in the order of their names without leading zeros: 1, 10, 11, 2."""


@dataclass(frozen=True, kw_only=True)
class TrackFaultSettings:
    """Thresholds at which a change of the tracks counts as the cause of their jumps."""

    jump: float = 4.0
    """A place is a jump if it is farther from its prediction than this many times the 95 % quantile of all places."""
    least_far: float = 0.5
    """Share of the places that are exactly zero that must be jumps."""
    largest_ratio: float = 0.25
    """With two tracks exchanged back, their distance from the prediction is below this ratio of that without it."""
    largest_order_ratio: float = 0.5
    """With frames in another order, the steps between them are below this ratio of those without it."""
    order_jump: float = 3.0
    """Only steps of more than this many times their median are explained by another order of single frames."""


TRACK_FAULT_DEFAULTS = TrackFaultSettings()
"""Default thresholds of the faults of tracks. Chosen by hand on four sequences. In three held-out ones, as given and
with noise of 0.5 % of their size, no fault is named; of planted ones 90 to 100 % are (`bench
nonrigid/planted_track_faults`)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackFault:
    """A fault of tracks, with what its repair achieves."""

    kind: str
    """`zeros`, `repeated`, `order` (of frames) or `exchanged` (tracks)."""
    frames: tuple[int, ...]
    """The frames that are concerned, or the first one from which tracks are exchanged."""
    points: tuple[int, ...] = ()
    """The points that are concerned."""
    count: int = 0
    """Number of places or frames that are concerned; `ALL_BY_NAME` for frames in the order of their names."""
    before: float = float("nan")
    """Largest or summed step that does not fit, in the unit of the tracks."""
    after: float = float("nan")
    """The same with the repair."""


def track_faults(
    places: Floats, *, views: int = 1, settings: TrackFaultSettings = TRACK_FAULT_DEFAULTS
) -> tuple[TrackFault, ...]:
    """Find faults of tracks by undoing them.

    Args:
        places: (F, K, P) coordinates of P points, those of all views one after the other; NaN where a point is missing.
        views: Number of views; each has K / `views` coordinates.
        settings: Thresholds.

    Returns:
        The faults; each was looked for after the ones before it were undone.
    """
    found: list[TrackFault] = []
    blank, fault = _zeros(places, views, settings)
    if fault is not None:
        found.append(fault)
        places = np.where(blank, np.nan, places)
    repeated = _repeated(places)
    found += repeated
    kept = np.setdiff1d(np.arange(len(places)), [f for fault in repeated for f in fault.frames])
    order, disorder = _order(places[kept], kept, settings)
    found += disorder
    # The frames that are named are those of the input.
    found += _exchanges(places[kept][order], kept[order], settings)
    return tuple(found)


def _distance(places: Floats) -> Floats:
    """Return the norm over the coordinates; NaN where any is unknown."""
    return np.asarray(np.sqrt((places**2).sum(-2)))


def _zeros(places: Floats, views: int, settings: TrackFaultSettings) -> tuple[Mask, TrackFault | None]:
    """Find places that are exactly zero in a view, far from where the same point is otherwise."""
    frames, size, points = places.shape
    own = places.reshape(frames, views, size // views, points)
    zero = (own == 0).all(2)
    steps = _distance(np.diff(own, axis=0))
    usual = steps[~(zero[1:] | zero[:-1])]
    usual = usual[np.isfinite(usual)]
    limit = settings.jump * float(np.quantile(usual, 0.95)) if len(usual) else np.inf
    seen = np.isfinite(own).all(2) & ~zero
    # A point at the origin is no missing one, nor is one that passes through it.
    zero &= seen.any(0)
    far = [
        _interpolated(own[:, c, :, p], seen[:, c, p])[zero[:, c, p]] > limit
        for c in range(views) for p in np.flatnonzero(zero[:, c].any(0))
    ]  # fmt: skip
    zero &= bool(far) and float(np.concatenate(far).mean()) > settings.least_far
    blank = np.broadcast_to(zero[:, :, None], own.shape).reshape(places.shape)
    if not zero.any():
        return blank, None
    where = zero.any(1)
    return blank, TrackFault(
        kind="zeros", frames=tuple(np.flatnonzero(where.any(1)).tolist()),
        points=tuple(np.flatnonzero(where.any(0)).tolist()), count=int(zero.sum()),
        before=float(np.nanmax(steps)), after=float(usual.max()),
    )  # fmt: skip


def _interpolated(track: Floats, seen: Mask) -> Floats:
    """Return the distance (F,) from zero of a track (F, K), interpolated linearly between the frames that are seen."""
    frames = np.arange(len(track))
    return np.asarray(np.linalg.norm([np.interp(frames, frames[seen], each[seen]) for each in track.T], axis=0))


def _repeated(places: Floats) -> list[TrackFault]:
    """Find frames that are equal to the one before, while others differ."""
    known = np.isfinite(places)
    same = (np.where(known, places, 0.0)[1:] == np.where(known, places, 0.0)[:-1]).all((1, 2))
    same &= (known[1:] == known[:-1]).all((1, 2)) & known[1:].any((1, 2))
    if not same.any() or same.all():
        return []
    frames = tuple((np.flatnonzero(same) + 1).tolist())
    return [TrackFault(kind="repeated", frames=frames, count=len(frames))]


def _apart(places: Floats) -> Floats:
    """Return the RMS distance (F, F) of the points of two frames that are seen in both; NaN without any."""
    frames = len(places)
    known = np.isfinite(places).all(1).astype(float)
    flat = np.where(np.isfinite(places), places, 0.0)
    flat = flat * known[:, None]
    squares = (flat**2).sum(1)
    both = known @ known.T
    total = squares @ known.T + known @ squares.T - 2 * np.einsum("fkp,gkp->fg", flat, flat, optimize=True)
    apart = np.sqrt(np.maximum(total, 0.0) / np.where(both > 0, both, np.nan))
    return np.asarray(np.where(np.eye(frames, dtype=bool), 0.0, apart))


def _order(
    places: Floats, names: Integers, settings: TrackFaultSettings
) -> tuple[Integers, list[TrackFault]]:  # fmt: skip
    """Find another order of the frames in which the steps between them are much smaller."""
    frames = len(places)
    order = np.arange(frames)
    apart = _apart(places)
    apart = np.where(np.isfinite(apart), apart, np.nanmedian(apart))
    # Files without leading zeros come as 1, 10, 11, 2, ... in the order of their names; they are counted from 0 or 1.
    orders = [np.argsort(np.argsort([str(n) for n in range(start, start + frames)])) for start in (0, 1)]
    by_name = min(orders, key=lambda each: _length(apart, each))
    before, after = _length(apart, order), _length(apart, by_name)
    if after < settings.largest_order_ratio * before:
        changed = tuple(names[np.flatnonzero(by_name != order)].tolist())
        return by_name, [TrackFault(kind="order", frames=changed, count=ALL_BY_NAME, before=before, after=after)]
    usual = float(np.median(apart[order[1:], order[:-1]]))
    moved: list[int] = []
    before = after = 0.0
    for _ in range(_CHANGED_FRAMES):
        best = _best_move(apart, order, usual, settings)
        if best is None:
            break
        order, frame, own, repaired = best
        moved.append(int(names[frame]))
        before, after = before + own, after + repaired
    if not moved or len(moved) == _CHANGED_FRAMES:
        return np.arange(frames), []
    frames_moved = tuple(sorted(set(moved)))
    return order, [TrackFault(kind="order", frames=frames_moved, count=len(frames_moved), before=before, after=after)]


def _length(apart: Floats, order: Integers) -> float:
    return float(apart[order[1:], order[:-1]].sum())


def _best_move(
    apart: Floats, order: Integers, usual: float, settings: TrackFaultSettings
) -> tuple[Integers, int, float, float] | None:  # fmt: skip
    """Put one frame in another place; return the new order, the frame, and the changed steps before and after."""
    best: tuple[float, Integers, int, float, float] | None = None
    steps = apart[order[1:], order[:-1]]
    for at in np.flatnonzero(steps > settings.order_jump * usual):
        for k in (int(at), int(at) + 1):
            rest = np.delete(order, k)
            frame = int(order[k])
            closed = np.insert(apart[rest[1:], rest[:-1]], [0, len(rest) - 1], 0.0)
            ahead = np.concatenate([[0.0], apart[rest, frame]])
            behind = np.concatenate([apart[rest, frame], [0.0]])
            costs = ahead + behind - closed
            j = int(np.argmin(costs))
            if j == k:
                continue
            gap = float(apart[order[k - 1], order[k + 1]]) if 0 < k < len(order) - 1 else 0.0
            own = float(ahead[k] + behind[k] + closed[j])
            repaired = float(gap + ahead[j] + behind[j])
            if repaired < settings.largest_order_ratio * own and (best is None or own - repaired > best[0]):
                best = own - repaired, np.insert(rest, j, frame), frame, own, repaired
    return None if best is None else best[1:]


def _exchanges(places: Floats, names: Integers, settings: TrackFaultSettings) -> Iterator[TrackFault]:
    """Yield pairs of tracks that are exchanged from some frame on."""
    places = np.array(places)
    usual = _distance(places[2:] - 2 * places[1:-1] + places[:-2])
    usual = usual[np.isfinite(usual)]
    if not len(usual):
        return
    limit = settings.jump * float(np.quantile(usual, 0.95))
    for f in range(2, len(places)):
        ahead = np.where(np.isfinite(places[f - 2]), 2 * places[f - 1] - places[f - 2], places[f - 1])
        off = _distance(places[f] - ahead)
        jumped = np.flatnonzero(np.nan_to_num(off) > limit)
        found = []
        for a, b in combinations(jumped.tolist(), 2):
            own = float(np.hypot(off[a], off[b]))
            back = float(np.linalg.norm(places[f][:, [b, a]] - ahead[:, [a, b]]))
            if back < settings.largest_ratio * own:
                found.append((back / own, a, b, own, back))
        taken: set[int] = set()
        for _, a, b, own, back in sorted(found):
            if not {a, b} & taken:
                taken |= {a, b}
                places[f:, :, [a, b]] = places[f:, :, [b, a]]
                yield TrackFault(
                    kind="exchanged", frames=(int(names[f]),), points=(a, b), count=len(places) - f, before=own,
                    after=back,
                )  # fmt: skip
