"""Exchanged labels: pairs of markers that carry each other's name, detected by distances within their clusters."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np

from marey.arrays import Floats, Integers, Mask, true_runs
from marey.markers.data.clusters import Cluster
from marey.markers.data.trajectories import MarkerTrajectories

_MAXIMUM_DISTANCES = 10_000_000
"""Distances held in memory at once (80 MB)."""


@dataclass(frozen=True, kw_only=True)
class LabelExchangeSettings:
    """Settings of the search for exchanged labels.

    The defaults were chosen by hand; how many exchanges they find is measured in docs/accuracy/markers.md ("Labels
    exchanged at random"), not other values.
    """

    largest_error_ratio: float = 0.5
    """After the exchange, the error of the distances must be below this ratio of the error before."""
    least_gain_m: float = 0.008
    """And smaller by at least this much (RMS) [m], because skin changes distances by a few millimetres."""
    whole_trial_share: float = 0.9
    """Share of the common frames from which on an exchange counts as one over the whole trial."""
    largest_crossing_ratio: float = 0.3
    """A pair is exchanged if its steps to the other marker's position are below this ratio of its own steps."""
    largest_spread_ratio: float = 0.7
    """A pair belongs to each other's clusters when distances vary there by less than this ratio."""
    least_spread_gain_m: float = 0.003
    """And by at least this much less, for the two markers together [m]."""


LABEL_EXCHANGE_DEFAULTS = LabelExchangeSettings()
"""Default settings of the search for exchanged labels."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LabelExchange:
    """Two labels that are exchanged in some frames."""

    labels: tuple[str, str]
    frames: Mask
    """(F,) True where they appear to be exchanged."""

    @property
    def note(self) -> str:
        """The exchange as a sentence for the user."""
        where = "in every frame" if self.frames.all() else f"in the frames {ranges(self.frames)}"
        return f"{self.labels[0]} and {self.labels[1]} look exchanged {where}."


def ranges(frames: Mask, most: int = 6) -> str:
    """Format a mask of frames (F,) as ranges: `3-10, 50`; after `most` ranges only their number is given."""
    runs = [(first, end - 1) for first, end in true_runs(frames)]
    text = ", ".join(f"{a}-{b}" if b > a else f"{a}" for a, b in runs[:most])
    return text + (f" and {len(runs) - most} further ranges" if len(runs) > most else "")


def find_exchanges(
    trajectories: MarkerTrajectories,
    clusters: Sequence[Cluster],
    known: Floats | None = None,
    settings: LabelExchangeSettings = LABEL_EXCHANGE_DEFAULTS,
) -> tuple[LabelExchange, ...]:
    """Find pairs of labels that are exchanged in some frames, or over the whole trial.

    Distances between the markers of a cluster change only by the deformation of the skin. Two labels count as exchanged
    in the frames in which all distances from them to the rest of their clusters are much closer to the usual distances
    after exchanging the two. The usual distances are the medians over the trial, and those of `known`. Labels of two
    clusters that are exchanged over the whole trial are detected because each moves with the other's cluster. Where two
    markers have similar distances to the rest, the exchange is detected because both jump to the other's position.

    Args:
        trajectories: Marker trajectories of the trial.
        clusters: Clusters of its markers.
        known: (M, 3) positions of all markers of `trajectories` in a posture with correct labels (a static trial) [m];
            NaN where unknown. They make an exchange of two labels of one cluster over the whole trial detectable.
        settings: Thresholds of the search.

    Returns:
        The pairs, each listed once; none with a point that was computed from other markers.
    """
    inside = [trajectories.labels.index(label) for cluster in clusters for label in cluster.labels]
    points, starts = trajectories.points[:, inside], np.cumsum([0, *(len(cluster.labels) for cluster in clusters)])
    columns = [list(range(a, b)) for a, b in pairwise(starts)]
    owner = {m: c for c, members in enumerate(columns) for m in members}
    at_once = max(1, _MAXIMUM_DISTANCES // max(1, len(inside)) ** 2)
    thinned = points[:: -(-len(points) // at_once)]
    between = _distances(thinned, thinned)
    usual = [_median(between)]
    if known is not None:
        usual.append(_distances(known[None, inside], known[None, inside])[0])
    found: dict[tuple[int, int], Mask] = {}
    for proto in usual:
        for pair, frames in _find_by_distance(points, proto, columns, owner, at_once, settings).items():
            found.setdefault(pair, frames)
    # Steps and distances are informative for the remaining pairs only after these are corrected.
    for pair, frames in _find_by_jumps(_corrected(points, found), columns, settings).items():
        found.setdefault(pair, frames)
    thinned = _corrected(points, found)[:: -(-len(points) // at_once)]
    for pair in _find_between_clusters(_distances(thinned, thinned), columns, owner, settings):
        found.setdefault(pair, np.ones(len(points), bool))
    computed = {label for cluster in clusters for label in cluster.computed}
    pairs = [
        LabelExchange(labels=(trajectories.labels[inside[a]], trajectories.labels[inside[b]]), frames=frames)
        for (a, b), frames in sorted(found.items())
    ]
    return tuple(pair for pair in pairs if not computed & set(pair.labels))


def _corrected(points: Floats, found: Mapping[tuple[int, int], Mask]) -> Floats:
    """Return points (F, M, 3) with the exchanges undone."""
    right = np.array(points)
    for pair, frames in found.items():
        right[frames] = right[frames][:, _exchanging(pair, points.shape[1])]
    return right


def _find_by_distance(
    points: Floats,
    usual: Floats,
    columns: list[list[int]],
    owner: dict[int, int],
    at_once: int,
    settings: LabelExchangeSettings,
) -> dict[tuple[int, int], Mask]:
    """Find exchanged pairs section by section, so that the distances of a long trial fit into memory."""
    found: dict[tuple[int, int], Mask] = {}
    for start in range(0, len(points), at_once):
        stretch = points[start : start + at_once]
        for pair, frames in _find_greedily(_distances(stretch, stretch), usual, columns, owner, settings).items():
            found.setdefault(pair, np.zeros(len(points), bool))[start : start + at_once] = frames
    return found


def exchanges_against_posture(
    trajectories: MarkerTrajectories,
    clusters: Sequence[Cluster],
    labels: Sequence[str],
    points: Floats,
    settings: LabelExchangeSettings = LABEL_EXCHANGE_DEFAULTS,
) -> tuple[LabelExchange, ...]:
    """Find pairs of labels of one cluster that are exchanged over the whole trial, relative to another trial.

    Args:
        trajectories: Marker trajectories of the trial.
        clusters: Clusters of its markers.
        labels: N labels of the other trial.
        points: (N, 3) positions of those markers in a posture of the other trial [m]; NaN where unknown.
        settings: Thresholds of the search.

    Returns:
        The pairs.
    """
    places = dict(zip(labels, points, strict=True))
    known = np.array([places.get(label, np.full(3, np.nan)) for label in trajectories.labels])
    inside = {label: cluster.segment for cluster in clusters for label in cluster.labels}
    there = {label: trajectories.present[:, m] for m, label in enumerate(trajectories.labels)}
    return tuple(
        exchange
        for exchange in find_exchanges(trajectories, clusters, known, settings)
        if inside[exchange.labels[0]] == inside[exchange.labels[1]]
        and exchange.frames[there[exchange.labels[0]] & there[exchange.labels[1]]].mean() > settings.whole_trial_share
    )


def undo_exchanges(trajectories: MarkerTrajectories, exchanges: Sequence[LabelExchange]) -> MarkerTrajectories:
    """Undo exchanges of labels in the frames in which they occur."""
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
    """Return the order (M,) of columns with two of them exchanged."""
    order = np.arange(count)
    order[list(pair)] = pair[::-1]
    return order


def _distances(first: Floats, second: Floats) -> Floats:
    """Return the distances (F, M, N) between points (F, M, 3) and (F, N, 3)."""
    return np.asarray(np.linalg.norm(first[:, :, None] - second[:, None], axis=-1))


def _median(values: Floats) -> Floats:
    """Return the lower median over the frames (F, ...); NaN for entries that are never known."""
    ordered = np.sort(values, 0)  # NaN last
    count = np.isfinite(values).sum(0)
    middle = np.maximum(count - 1, 0) // 2
    return np.asarray(np.take_along_axis(ordered, middle[None], 0)[0])


def _distance_error(between: Floats, usual: Floats, at: int, label: int, others: list[int]) -> Floats:
    """Return the mean square error (F,) [m2] of the distances from point `at` to others, if it were `label`."""
    off = (between[:, at, others] - usual[label, others]) ** 2
    known = np.isfinite(off)
    count = known.sum(1)
    return np.where(count >= 2, np.where(known, off, 0).sum(1) / np.maximum(count, 1), np.nan)


def _find_greedily(
    between: Floats, usual: Floats, columns: list[list[int]], owner: dict[int, int], settings: LabelExchangeSettings
) -> dict[tuple[int, int], Mask]:
    """Undo the exchange with the largest gain and repeat: an exchanged pair distorts its neighbours' distances."""
    between = between.copy()
    found: dict[tuple[int, int], Mask] = {}
    for _ in range(len(owner)):
        gains = _gains(between, usual, columns, owner, found, settings)
        if not gains:
            break
        pair = max(gains, key=lambda pair: gains[pair].sum())
        frames = found[pair] = gains[pair] > 0
        order = _exchanging(pair, between.shape[1])
        between[frames] = between[frames][:, order][:, :, order]
    return found


def _gains(
    between: Floats,
    usual: Floats,
    columns: list[list[int]],
    owner: dict[int, int],
    done: dict[tuple[int, int], Mask],
    settings: LabelExchangeSettings,
) -> dict[tuple[int, int], Floats]:
    """Return for pairs of labels by how much (F,) exchanging them reduces the distance error [m]; 0 if not clearly."""
    suspects = {}
    for m, c in owner.items():
        own = _distance_error(between, usual, m, m, [k for k in columns[c] if k != m])
        suspects[m] = np.nan_to_num(own) > settings.least_gain_m**2
    gains: dict[tuple[int, int], Floats] = {}
    for a, b in combinations(sorted(owner), 2):
        if (a, b) in done or not (suspects[a] & suspects[b]).any():
            continue
        rest = [[k for k in columns[owner[m]] if k not in (a, b)] for m in (a, b)]
        now = _distance_error(between, usual, a, a, rest[0]) + _distance_error(between, usual, b, b, rest[1])
        then = _distance_error(between, usual, b, a, rest[0]) + _distance_error(between, usual, a, b, rest[1])
        gain = np.sqrt(now / 2) - np.sqrt(then / 2)
        good = (then < settings.largest_error_ratio**2 * now) & (gain > settings.least_gain_m)
        if good.any():
            gains[a, b] = np.where(good, gain, 0.0)
    return gains


def _find_by_jumps(
    points: Floats, columns: list[list[int]], settings: LabelExchangeSettings
) -> dict[tuple[int, int], Mask]:
    """Find pairs of one cluster that jump to each other's position, and the frames between (or outside) their jumps."""
    found = {}
    for members in columns:
        # The cluster's own motion is subtracted, so that a fast movement does not count as a jump.
        local = points[:, members] - _median(np.swapaxes(points[:, members], 0, 1))[:, None]
        for i, j in combinations(range(len(members)), 2):
            steps = [np.linalg.norm(local[1:, p] - local[:-1, q], axis=-1) for p, q in ((i, i), (j, j), (i, j), (j, i))]
            stayed, crossed = steps[0] + steps[1], steps[2] + steps[3]
            jump = crossed < settings.largest_crossing_ratio * stayed
            jump &= stayed - crossed > 2 * settings.least_gain_m
            if jump.any():
                after = np.concatenate([[False], np.cumsum(jump) % 2 == 1])
                found[members[i], members[j]] = after if after.mean() <= 0.5 else ~after
    return found


def _find_between_clusters(
    between: Floats, columns: list[list[int]], owner: dict[int, int], settings: LabelExchangeSettings
) -> list[tuple[int, int]]:
    """Find pairs of two clusters of which each keeps its distances to the other's cluster, in order of clearness."""
    spread = _spread(between)
    varies = np.array([
        [_known_median(spread[m, [k for k in members if k != m]]) for members in columns] for m in sorted(owner)
    ])  # fmt: skip
    clear = []
    for a, b in combinations(sorted(owner), 2):
        c, d = owner[a], owner[b]
        own, other = varies[a, c] + varies[b, d], varies[a, d] + varies[b, c]
        clearly = other < settings.largest_spread_ratio * own and own - other > settings.least_spread_gain_m
        if c != d and clearly:
            clear.append((own - other, a, b))
    pairs: list[tuple[int, int]] = []
    for _, a, b in sorted(clear, reverse=True):
        if not {a, b} & {m for pair in pairs for m in pair}:
            pairs.append((a, b))
    return pairs


def _spread(values: Floats) -> Floats:
    """Return the standard deviation over the frames (F, ...); NaN with fewer than two known values."""
    known = np.isfinite(values)
    count = known.sum(0)
    mean = np.where(known, values, 0).sum(0) / np.maximum(count, 1)
    square = np.where(known, (values - mean) ** 2, 0).sum(0) / np.maximum(count - 1, 1)
    return np.where(count > 1, np.sqrt(square), np.nan)


def _known_median(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")
