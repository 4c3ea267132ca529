"""Filling of gaps in marker trajectories, by a spline over time or from the cluster's other markers."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.interpolate import Akima1DInterpolator

from marey.arrays import Floats, Integers, Mask, freeze_fields, true_runs
from marey.markers.data.clusters import MINIMUM_MARKERS, Cluster
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.preprocessing.low_rank import predict_markers

MEASURED, SPLINE, FROM_CLUSTER, STILL_MISSING = 0, 1, 2, 3
"""Origin of a point: measured, filled by a spline, filled from the cluster, or left missing."""


@dataclass(frozen=True, kw_only=True)
class HeldOutGapSettings:
    """How the errors of filling are measured on artificial gaps.

    The defaults were chosen by hand; results were not measured against other values.
    """

    ranks: tuple[int, ...] = (0, 1, 2, 4, 6, 8)
    """Candidate numbers of modes of the cluster's change of shape."""
    lengths: tuple[int, ...] = (1, 2, 4, 8, 16, 32, 64, 128, 256)
    """Lengths of artificial gaps [frames]."""
    maximum_cuts: int = 40
    """Most artificial gaps of each length in one round."""
    enough_cuts: int = 8
    """Artificial gaps of each length after which no further round is made."""
    cut_share: float = 0.1
    """Largest share of the measured points that is cut in one round."""
    rounds: int = 4
    """Most rounds for each length."""
    frames: int = 4000
    """Frames in the middle of a long trial on which the errors are measured."""
    markers_per_cut: int = 6
    """Markers of a cluster for each one that may be cut in the same frame."""
    draws_per_cut: int = 20
    """Random draws for each wanted gap."""
    largest_share: float = 0.35
    """Largest length of an artificial gap as a share of the trial."""
    reach_ratio: float = 1.5
    """A gap longer than this multiple of the longest one with a measured error has no expected error."""
    real_gap_ratio: float = 4.0
    """Artificial gaps are shorter than this multiple of the longest real gap."""


HELD_OUT_GAPS = HeldOutGapSettings()
"""Default settings of artificial gaps."""


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldOutErrors:
    """Distance of filled points from measured ones, determined on artificial gaps in measured trajectories."""

    group: str
    """The segment, or "" for markers that belong to none."""
    rank: int
    """Number of modes with which filling from the cluster is most accurate."""
    lengths: Integers
    """(L,) lengths of the artificial gaps [frames]."""
    spline_rms: Floats
    """(L,) RMS distance of points filled by a spline [m]; NaN where no such gap could be cut."""
    cluster_rms: Floats
    """(L,) RMS distance of points filled from the cluster [m]; NaN where the cluster cannot fill."""

    def best(self, length: int, ways: Sequence[int], settings: HeldOutGapSettings = HELD_OUT_GAPS) -> tuple[int, float]:
        """Return the most accurate way to fill a gap, and the expected RMS distance [m].

        Between the measured lengths the distance is interpolated over the logarithm of the length. It is NaN for a gap
        much longer than any of them, and where nothing was measured.

        Args:
            length: Length of the gap [frames].
            ways: SPLINE, FROM_CLUSTER, or both.
            settings: Settings with which the errors were measured.
        """
        options = {SPLINE: self.spline_rms, FROM_CLUSTER: self.cluster_rms}
        rms = {way: _expected_error(self.lengths, options[way], length, settings) for way in ways}
        way = min(rms, key=lambda way: (np.isnan(rms[way]), rms[way]))
        return way, rms[way]


def _expected_error(lengths: Integers, values: Floats, length: int, settings: HeldOutGapSettings) -> float:
    """Interpolate the error of a gap's length [m]; NaN far beyond the longest measured one."""
    known = np.isfinite(values)
    if not known.any() or length > settings.reach_ratio * lengths[known].max():
        return float("nan")
    return float(np.interp(np.log(length), np.log(lengths[known]), values[known]))


@dataclass(frozen=True, eq=False, kw_only=True)
class FilledGaps:
    """Trajectories whose gaps are filled where that is accurate enough, and how each point was filled."""

    trajectories: MarkerTrajectories
    """The trajectories; `filled` is True where a point was filled, measured points and residuals are unchanged."""
    way: Integers
    """(F, M) MEASURED, SPLINE, FROM_CLUSTER or STILL_MISSING."""
    sd: Floats
    """(F, M) standard deviation of a filled coordinate [m], from artificial gaps of its length; NaN elsewhere."""
    held_out: tuple[HeldOutErrors, ...]
    """One per segment with a gap, and one for the markers that belong to none."""

    def __post_init__(self) -> None:
        freeze_fields(self, "way", dtype=np.int64)
        freeze_fields(self, "sd")

    @property
    def notes(self) -> tuple[str, ...]:
        """What was filled and what was left, one sentence each."""
        names = {SPLINE: "by a spline over time", FROM_CLUSTER: "from the cluster's other markers"}
        notes = [
            f"{count} points were filled {name} (expected RMS {_rms_distance_mm(self.sd[self.way == way]):.1f} mm)."
            for way, name in names.items()
            if (count := int((self.way == way).sum()))
        ]
        left = int((self.way == STILL_MISSING).sum())
        return tuple(notes + ([f"{left} missing points were left empty."] if left else []))


def _rms_distance_mm(sd: Floats) -> float:
    """Return the RMS distance [mm] of points with these standard deviations of a coordinate [m]."""
    return float(np.sqrt(3 * (sd**2).mean()) * 1e3)


def fill_gaps(
    trajectories: MarkerTrajectories,
    clusters: Sequence[Cluster] = (),
    *,
    ways: Sequence[int] = (SPLINE, FROM_CLUSTER),
    largest_error_m: float = 0.01,
    seed: int = 0,
    settings: HeldOutGapSettings = HELD_OUT_GAPS,
) -> FilledGaps:
    """Fill each gap in the way that is more accurate on artificial gaps of the same length.

    A spline follows the marker's own path and fills only between two measured points. The other markers of the cluster
    predict a marker from the cluster's shape and a few modes of its change, relative to the rigid motion; the
    prediction error at the ends of the gap is interpolated and subtracted in between. For each cluster, gaps of 1, 2,
    4, ... frames are cut into measured trajectories, filled both ways, and compared.

    Args:
        trajectories: Trajectories with gaps.
        clusters: Clusters of markers that move together; markers of none are filled by a spline.
        ways: SPLINE, FROM_CLUSTER, or both to choose from.
        largest_error_m: A gap stays empty if the error of artificial gaps of its length exceeds this RMS distance [m].
        seed: Random seed of the positions of artificial gaps.
        settings: How the errors of filling are measured on artificial gaps.

    Returns:
        The filled trajectories; gaps that neither way fills accurately enough stay empty.
    """
    points = np.array(trajectories.points)
    way = np.where(trajectories.present, MEASURED, STILL_MISSING)
    sd = np.full(way.shape, np.nan)
    tables = []
    for name, columns in _groups(trajectories, clusters):
        if trajectories.present[:, columns].all():
            continue
        table = held_out(points[:, columns], name, np.random.default_rng(seed), settings)
        tables.append(table)
        filled = _fill_group(points[:, columns], table, ways, largest_error_m, settings)
        points[:, columns], way[:, columns], sd[:, columns] = filled
    was = trajectories.filled | ((way == SPLINE) | (way == FROM_CLUSTER))
    filled_trajectories = replace(trajectories, points=points, filled=was)
    return FilledGaps(trajectories=filled_trajectories, way=way, sd=sd, held_out=tuple(tables))


def _groups(trajectories: MarkerTrajectories, clusters: Sequence[Cluster]) -> list[tuple[str, list[int]]]:
    """List the columns of each cluster, and those of no cluster under the name ""."""
    groups = [(c.segment, [trajectories.labels.index(label) for label in c.labels]) for c in clusters]
    inside = {column for _, columns in groups for column in columns}
    others = [n for n in range(len(trajectories.labels)) if n not in inside]
    return [*groups, *([("", others)] if others else [])]


def _gaps(points: Floats) -> list[tuple[int, int, int]]:
    """List the gaps of markers (F, M, 3) as (marker, first frame, frame after the last)."""
    missing: Mask = np.asarray(~np.isfinite(points).all(-1))
    return [(m, *run) for m in range(points.shape[1]) for run in true_runs(missing[:, m])]


def _fill_group(
    points: Floats, table: HeldOutErrors, ways: Sequence[int], largest_error_m: float, settings: HeldOutGapSettings
) -> tuple[Floats, np.ndarray, Floats]:
    """Fill the gaps of one group (F, M, 3); return points, ways (F, M) and standard deviations (F, M) [m]."""
    filled, present = points.copy(), np.isfinite(points).all(-1)
    way, sd = np.where(present, MEASURED, STILL_MISSING), np.full(present.shape, np.nan)
    candidates = {SPLINE: spline(points)}
    if np.isfinite(table.cluster_rms).any():
        candidates[FROM_CLUSTER] = from_cluster(points, table.rank)
    for marker, start, end in _gaps(points):
        at_end = start == 0 or end == len(points)
        # A gap at an end of the trial has a measured point on one side only: it counts like a gap of twice its length.
        able = [way for way in ways if way in candidates and not (at_end and way == SPLINE)]
        length = 2 * (end - start) if at_end else end - start
        best, rms = table.best(length, able, settings) if able else (STILL_MISSING, np.inf)
        if not rms <= largest_error_m:
            continue
        put = candidates[best][start:end, marker]
        done = np.isfinite(put).all(-1)
        filled[start:end, marker][done] = put[done]
        way[start:end, marker][done] = best
        sd[start:end, marker][done] = rms / np.sqrt(3)
    return filled, way, sd


def spline(points: Floats) -> Floats:
    """Interpolate each marker's known points by Akima's cubic spline.

    Its slopes depend on the nearest points only ([Akima1970]), so that noise beside a gap does not cause oscillations
    within it.

    Args:
        points: (F, M, 3) [m]; NaN where missing.

    Returns:
        (F, M, 3); NaN before the first and after the last known point.
    """
    through = np.full_like(points, np.nan)
    frames = np.arange(len(points))
    for m in range(points.shape[1]):
        known = np.flatnonzero(np.isfinite(points[:, m]).all(-1))
        if len(known) > 3:
            inside = slice(known[0], known[-1] + 1)
            through[inside, m] = Akima1DInterpolator(known, points[known, m])(frames[inside])
    return through


def from_cluster(points: Floats, rank: int) -> Floats:
    """Predict each marker from the others of its cluster, continuous with its own path at the ends of each gap.

    Args:
        points: (F, M, 3) of one cluster [m]; NaN where missing.
        rank: Number of modes of the cluster's change of shape.

    Returns:
        (F, M, 3); NaN in frames with fewer than three markers.
    """
    predicted = predict_markers(points, rank)
    off = points - predicted
    frames = np.arange(len(points))
    for m in range(points.shape[1]):
        known = np.flatnonzero(np.isfinite(off[:, m]).all(-1))
        if len(known):
            off[:, m] = np.stack([np.interp(frames, known, off[known, m, axis]) for axis in range(3)], -1)
    return np.asarray(predicted + off)


def held_out(
    points: Floats, group: str, rng: np.random.Generator, settings: HeldOutGapSettings = HELD_OUT_GAPS
) -> HeldOutErrors:
    """Measure the error of both ways of filling on artificial gaps; for a long trial, in its middle.

    Args:
        points: (F, M, 3) the markers of one cluster, or of none (`group` is "") [m].
        group: Name of the segment.
        rng: Generator of the positions of the gaps.
        settings: How the artificial gaps are made.

    Returns:
        The errors for each length.
    """
    longest = max((end - start for _, start, end in _gaps(points)), default=1)
    points = points[max(0, (len(points) - settings.frames) // 2) :][: settings.frames]
    usable = [n for n in settings.lengths if n <= settings.largest_share * len(points)]
    lengths = [n for n in usable if n == 1 or n < settings.real_gap_ratio * longest] or [1]
    cuts = {n: _cuts(points, n, rng, settings) for n in lengths}
    spline_rms = [_rms(spline, points, cuts[n]) for n in lengths]
    cluster_rms, rank = [np.nan] * len(lengths), 0
    if group and points.shape[1] > MINIMUM_MARKERS:
        ranks = [r for r in settings.ranks if r <= min(len(points) // 4, points.shape[1])]
        middle = cuts[lengths[len(lengths) // 2]][:1]
        errors = [_rms(partial(from_cluster, rank=r), points, middle) for r in ranks]
        rank = ranks[int(np.nanargmin(errors))] if np.isfinite(errors).any() else 0
        cluster_rms = [_rms(partial(from_cluster, rank=rank), points, cuts[n]) for n in lengths]
    return HeldOutErrors(
        group=group, rank=rank, lengths=np.array(lengths), spline_rms=np.array(spline_rms),
        cluster_rms=np.array(cluster_rms),
    )  # fmt: skip


def _cuts(points: Floats, length: int, rng: np.random.Generator, settings: HeldOutGapSettings) -> list[Mask]:
    """Choose artificial gaps (F, M) of one length, in as many rounds as needed to have enough of them."""
    rounds, enough = [_cut(points, length, rng, settings)], settings.enough_cuts * length
    while len(rounds) < settings.rounds and rounds[0].any() and sum(cut.sum() for cut in rounds) < enough:
        rounds.append(_cut(points, length, rng, settings))
    return rounds


def _cut(points: Floats, length: int, rng: np.random.Generator, settings: HeldOutGapSettings) -> Mask:
    """Choose artificial gaps (F, M) with a measured point at both ends and enough other markers left."""
    known = np.isfinite(points).all(-1)
    frames, count = known.shape
    cut = np.zeros(known.shape, bool)
    made, most = 0, min(settings.maximum_cuts, max(1, int(settings.cut_share * known.sum() / length)))
    for draw in range(settings.draws_per_cut * settings.maximum_cuts):
        m, start = draw % count, int(rng.integers(1, max(frames - length, 2)))
        window = slice(start - 1, start + length + 1)
        others = cut[start : start + length].sum(1).max(initial=0)
        spared = others < max(1, count // settings.markers_per_cut)
        if start + length < frames and (known & ~cut)[window, m].all() and spared:
            cut[start : start + length, m] = True
            made += 1
        if made == most:
            break
    return cut


def _rms(fill: Callable[[Floats], Floats], points: Floats, cuts: Sequence[Mask]) -> float:
    """Return the RMS distance of filled points from the measured ones [m]; NaN where nothing was filled."""
    off = [(fill(np.where(cut[..., None], np.nan, points)) - points)[cut] for cut in cuts]
    squared = (np.concatenate(off) ** 2).sum(-1)
    known = np.isfinite(squared)
    return float(np.sqrt(squared[known].mean())) if known.any() else float("nan")
