"""Exchanged labels: two markers that carry each other's name, told by the distances to the rest of their clusters."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.markers.data.clusters import Cluster
from marey.markers.data.trajectories import MarkerTrajectories

_BETTER = 0.5  # exchanged, the distances must come out wrong by less than this share of what they are
_CLEAR_M = 0.008  # and by this much less, RMS: skin moves distances by a few millimetres
_ALL_ALONG = 0.9  # of the frames that show both
_MOST_DISTANCES = 10_000_000  # held at once: 80 MB
_CROSSED = 0.3  # a pair has jumped when its steps to the other's place are less than this share of its own
_MOVES_WITH = 0.7  # a pair belongs in each other's clusters when distances vary there by less than this share
_OWN_SD_M = 0.003  # and by this much less, for the two together


@dataclass(frozen=True, eq=False, kw_only=True)
class Exchange:
    """Two labels that stand for each other in some frames."""

    labels: tuple[str, str]
    frames: Mask
    """(F,) true where they look exchanged."""

    @property
    def note(self) -> str:
        """A plain sentence."""
        where = "in every frame" if self.frames.all() else f"in the frames {ranges(self.frames)}"
        return f"{self.labels[0]} and {self.labels[1]} look exchanged {where}."


def ranges(frames: Mask, most: int = 6) -> str:
    """Write frames (F,) as ranges: `3-10, 50`; the rest is counted after `most` of them."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], frames.astype(int), [0]])))
    runs = [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    text = ", ".join(f"{a}-{b}" if b > a else f"{a}" for a, b in runs[:most])
    return text + (f" and {len(runs) - most} further ranges" if len(runs) > most else "")


def find_exchanges(
    trajectories: MarkerTrajectories, clusters: Sequence[Cluster], known: Floats | None = None
) -> tuple[Exchange, ...]:
    """Find pairs of labels that are exchanged in some frames, or all along.

    In a cluster, distances between markers change by what the skin does. Two labels are taken for exchanged in the
    frames in which all distances from them to the rest of their clusters come out much nearer to the usual ones with
    the two exchanged. The usual ones are the median over the trial, and those of `known`. Labels of two clusters that
    are exchanged all along show in that each moves with the other's cluster. Where two markers lie alike to the rest,
    the exchange shows in both jumping to where the other was.

    Args:
        trajectories: Of the trial.
        clusters: Of its markers.
        known: (M, 3) where all markers of `trajectories` are in a posture whose labels are right (a static trial)
            [m]; NaN where not known. With it, two labels of one cluster that are exchanged all along are found, too.

    Returns:
        The pairs; none is named twice.
    """
    inside = [trajectories.labels.index(label) for cluster in clusters for label in cluster.labels]
    points, starts = trajectories.points[:, inside], np.cumsum([0, *(len(cluster.labels) for cluster in clusters)])
    columns = [list(range(a, b)) for a, b in pairwise(starts)]
    owner = {m: c for c, members in enumerate(columns) for m in members}
    at_once = max(1, _MOST_DISTANCES // max(1, len(inside)) ** 2)
    thinned = points[:: -(-len(points) // at_once)]
    between = _distances(thinned, thinned)
    usual = [_median(between)]
    if known is not None:
        usual.append(_distances(known[None, inside], known[None, inside])[0])
    found: dict[tuple[int, int], Mask] = {}
    for proto in usual:
        for pair, frames in _in_stretches(points, proto, columns, owner, at_once).items():
            found.setdefault(pair, frames)
    # Only with these put right do steps and distances tell the rest.
    for pair, frames in _jumped(_put_right(points, found), columns).items():
        found.setdefault(pair, frames)
    thinned = _put_right(points, found)[:: -(-len(points) // at_once)]
    for pair in _all_along(_distances(thinned, thinned), columns, owner):
        found.setdefault(pair, np.ones(len(points), bool))
    return tuple(
        Exchange(labels=(trajectories.labels[inside[a]], trajectories.labels[inside[b]]), frames=frames)
        for (a, b), frames in sorted(found.items())
    )


def _put_right(points: Floats, found: Mapping[tuple[int, int], Mask]) -> Floats:
    """Give points (F, M, 3) with pairs exchanged back."""
    right = np.array(points)
    for pair, frames in found.items():
        right[frames] = right[frames][:, _exchanging(pair, points.shape[1])]
    return right


def _in_stretches(
    points: Floats, usual: Floats, columns: list[list[int]], owner: dict[int, int], at_once: int
) -> dict[tuple[int, int], Mask]:
    """Look for exchanged pairs stretch by stretch, so that a long trial's distances need no more memory."""
    found: dict[tuple[int, int], Mask] = {}
    for start in range(0, len(points), at_once):
        stretch = points[start : start + at_once]
        for pair, frames in _one_by_one(_distances(stretch, stretch), usual, columns, owner).items():
            found.setdefault(pair, np.zeros(len(points), bool))[start : start + at_once] = frames
    return found


def exchanged_since(
    trajectories: MarkerTrajectories, clusters: Sequence[Cluster], labels: Sequence[str], points: Floats
) -> tuple[Exchange, ...]:
    """Find pairs of labels of one cluster that are exchanged all along, against a posture of another trial.

    Args:
        trajectories: Of the trial.
        clusters: Of its markers.
        labels: N labels of the other trial.
        points: (N, 3) where those markers were in its posture [m]; NaN where not known.
    """
    places = dict(zip(labels, points, strict=True))
    known = np.array([places.get(label, np.full(3, np.nan)) for label in trajectories.labels])
    inside = {label: cluster.segment for cluster in clusters for label in cluster.labels}
    there = {label: trajectories.present[:, m] for m, label in enumerate(trajectories.labels)}
    return tuple(
        exchange
        for exchange in find_exchanges(trajectories, clusters, known)
        if inside[exchange.labels[0]] == inside[exchange.labels[1]]
        and exchange.frames[there[exchange.labels[0]] & there[exchange.labels[1]]].mean() > _ALL_ALONG
    )


def exchange_back(trajectories: MarkerTrajectories, exchanges: Sequence[Exchange]) -> MarkerTrajectories:
    """Give two labels that were exchanged their own paths again, in the frames in which they were."""
    points, filled = np.array(trajectories.points), np.array(trajectories.filled)
    residuals = np.array(trajectories.residuals)
    for exchange in exchanges:
        first, second = (trajectories.labels.index(label) for label in exchange.labels)
        order = _exchanging((first, second), points.shape[1])
        points[exchange.frames] = points[exchange.frames][:, order]
        filled[exchange.frames] = filled[exchange.frames][:, order]
        residuals[exchange.frames] = residuals[exchange.frames][:, order]
    return replace(trajectories, points=points, filled=filled, residuals=residuals)


def _exchanging(pair: tuple[int, int], count: int) -> Integers:
    """Give the order (M,) of columns in which two have changed places."""
    order = np.arange(count)
    order[list(pair)] = pair[::-1]
    return order


def _distances(first: Floats, second: Floats) -> Floats:
    """Give the distances (F, M, N) between points (F, M, 3) and (F, N, 3)."""
    return np.linalg.norm(first[:, :, None] - second[:, None], axis=-1)


def _median(values: Floats) -> Floats:
    """Take the median over the frames (F, ...); NaN for what is never known."""
    ordered = np.sort(values, 0)  # NaN last
    count = np.isfinite(values).sum(0)
    middle = np.maximum(count - 1, 0) // 2
    return np.take_along_axis(ordered, middle[None], 0)[0]


def _misfit(between: Floats, usual: Floats, at: int, label: int, others: list[int]) -> Floats:
    """Say how far (F,) the point `at` is from being `label`, by its distances to others: mean square [m2]."""
    off = (between[:, at, others] - usual[label, others]) ** 2
    known = np.isfinite(off)
    count = known.sum(1)
    return np.where(count >= 2, np.where(known, off, 0).sum(1) / np.maximum(count, 1), np.nan)


def _one_by_one(
    between: Floats, usual: Floats, columns: list[list[int]], owner: dict[int, int]
) -> dict[tuple[int, int], Mask]:
    """Find the pair that gains most, exchange it back, look again: a wrong pair spoils its neighbours' distances."""
    between = between.copy()
    found: dict[tuple[int, int], Mask] = {}
    for _ in range(len(owner)):
        gains = _gains(between, usual, columns, owner, found)
        if not gains:
            break
        pair = max(gains, key=lambda pair: gains[pair].sum())
        frames = found[pair] = gains[pair] > 0
        order = _exchanging(pair, between.shape[1])
        between[frames] = between[frames][:, order][:, :, order]
    return found


def _gains(
    between: Floats, usual: Floats, columns: list[list[int]], owner: dict[int, int], done: dict[tuple[int, int], Mask]
) -> dict[tuple[int, int], Floats]:
    """Say for pairs of labels how much nearer (F,) the distances are to the usual ones when exchanged [m]; else 0."""
    suspects = {}
    for m, c in owner.items():
        own = _misfit(between, usual, m, m, [k for k in columns[c] if k != m])
        suspects[m] = np.nan_to_num(own) > _CLEAR_M**2
    gains: dict[tuple[int, int], Floats] = {}
    for a, b in combinations(sorted(owner), 2):
        if (a, b) in done or not (suspects[a] & suspects[b]).any():
            continue
        rest = [[k for k in columns[owner[m]] if k not in (a, b)] for m in (a, b)]
        now = _misfit(between, usual, a, a, rest[0]) + _misfit(between, usual, b, b, rest[1])
        then = _misfit(between, usual, b, a, rest[0]) + _misfit(between, usual, a, b, rest[1])
        gain = np.sqrt(now / 2) - np.sqrt(then / 2)
        good = (then < _BETTER**2 * now) & (gain > _CLEAR_M)
        if good.any():
            gains[a, b] = np.where(good, gain, 0.0)
    return gains


def _jumped(points: Floats, columns: list[list[int]]) -> dict[tuple[int, int], Mask]:
    """Find pairs of one cluster that jump to each other's place, and the frames between, or beyond, their jumps."""
    found = {}
    for members in columns:
        # The cluster's own way is taken off, so that a fast movement is no jump.
        local = points[:, members] - _median(np.swapaxes(points[:, members], 0, 1))[:, None]
        for i, j in combinations(range(len(members)), 2):
            steps = [np.linalg.norm(local[1:, p] - local[:-1, q], axis=-1) for p, q in ((i, i), (j, j), (i, j), (j, i))]
            stayed, crossed = steps[0] + steps[1], steps[2] + steps[3]
            jump = (crossed < _CROSSED * stayed) & (stayed - crossed > 2 * _CLEAR_M)
            if jump.any():
                after = np.concatenate([[False], np.cumsum(jump) % 2 == 1])
                found[members[i], members[j]] = after if after.mean() <= 0.5 else ~after
    return found


def _all_along(between: Floats, columns: list[list[int]], owner: dict[int, int]) -> list[tuple[int, int]]:
    """Find pairs of two clusters of which each keeps its distances to the other's cluster, the clearest first."""
    spread = _spread(between)
    varies = np.array([
        [_middle(spread[m, [k for k in members if k != m]]) for members in columns] for m in sorted(owner)
    ])  # fmt: skip
    clear = []
    for a, b in combinations(sorted(owner), 2):
        c, d = owner[a], owner[b]
        own, other = varies[a, c] + varies[b, d], varies[a, d] + varies[b, c]
        if c != d and other < _MOVES_WITH * own and own - other > _OWN_SD_M:
            clear.append((own - other, a, b))
    pairs: list[tuple[int, int]] = []
    for _, a, b in sorted(clear, reverse=True):
        if not {a, b} & {m for pair in pairs for m in pair}:
            pairs.append((a, b))
    return pairs


def _spread(values: Floats) -> Floats:
    """Give the standard deviation over the frames (F, ...); NaN with fewer than two."""
    known = np.isfinite(values)
    count = known.sum(0)
    mean = np.where(known, values, 0).sum(0) / np.maximum(count, 1)
    square = np.where(known, (values - mean) ** 2, 0).sum(0) / np.maximum(count - 1, 1)
    return np.where(count > 1, np.sqrt(square), np.nan)


def _middle(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")
