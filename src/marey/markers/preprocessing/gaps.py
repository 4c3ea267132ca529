"""Filling gaps in marker trajectories: by a spline over time or from the cluster's other markers, flagged."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.interpolate import Akima1DInterpolator

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.markers.data.clusters import Cluster
from marey.markers.data.labels import NEEDED
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.preprocessing.low_rank import predict
from marey.motion.filters import known_runs

MEASURED, SPLINE, FROM_CLUSTER, STILL_MISSING = 0, 1, 2, 3
_RANKS = (0, 1, 2, 4, 6, 8)
_LENGTHS = (1, 2, 4, 8, 16, 32, 64, 128, 256)  # frames
_CUTS = 40  # artificial gaps of each length, at most at a time
_CUTS_ENOUGH = 8
_CUT_SHARE = 0.1  # of what was measured, at a time
_ROUNDS = 4
_STRETCH = 4000  # frames in which filling is measured
_APART = 6  # markers to one that may be cut in a frame
_DRAWS = 20  # for each of them
_LARGEST_SHARE = 0.35  # of the trial


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldOut:
    """How far filled points lie from measured ones, found by cutting gaps into what was measured."""

    group: str
    """The segment, or "" for the markers of none."""
    rank: int
    """Modes with which the cluster fills best."""
    lengths: Integers
    """(L,) frames."""
    spline_rms: Floats
    """(L,) [m]; NaN where no such gap could be cut."""
    cluster_rms: Floats
    """(L,) [m]; NaN where the cluster cannot fill."""

    def best(self, length: int, ways: Sequence[int]) -> tuple[int, float]:
        """Say what fills a gap of some frames best, and the RMS distance to expect [m]; NaN where nothing is known.

        Between the lengths that were tried the distance is interpolated over the logarithm of the length; a longer gap
        than any of them is not answered for.

        Args:
            length: Of the gap, in frames.
            ways: SPLINE, FROM_CLUSTER, or both.
        """
        options = {SPLINE: self.spline_rms, FROM_CLUSTER: self.cluster_rms}
        rms = {way: _at(self.lengths, options[way], length) for way in ways}
        way = min(rms, key=lambda way: (np.isnan(rms[way]), rms[way]))
        return way, rms[way]


def _at(lengths: Integers, values: Floats, length: int) -> float:
    known = np.isfinite(values)
    if not known.any() or length > 1.5 * lengths[known].max():
        return float("nan")
    return float(np.interp(np.log(length), np.log(lengths[known]), values[known]))


@dataclass(frozen=True, eq=False, kw_only=True)
class FilledGaps:
    """Trajectories whose gaps are filled where that can be done well enough, and how."""

    trajectories: MarkerTrajectories
    """`filled` is true where a point was filled; measured points and their residuals are as they were."""
    way: Integers
    """(F, M) MEASURED, SPLINE, FROM_CLUSTER or STILL_MISSING."""
    sd: Floats
    """(F, M) standard deviation of a filled coordinate [m], as held-out gaps of its length showed; NaN elsewhere."""
    held_out: tuple[HeldOut, ...]
    """One a segment, and one for the markers of none, where there was a gap."""

    def __post_init__(self) -> None:
        freeze_fields(self, "way", dtype=np.int64)
        freeze_fields(self, "sd")

    @property
    def notes(self) -> tuple[str, ...]:
        """What was filled and what was left, a plain sentence each."""
        names = {SPLINE: "by a spline over time", FROM_CLUSTER: "from the cluster's other markers"}
        notes = [
            f"{count} points were filled {name} (expected RMS {_typical(self.sd[self.way == way]):.1f} mm)."
            for way, name in names.items()
            if (count := int((self.way == way).sum()))
        ]
        left = int((self.way == STILL_MISSING).sum())
        return tuple(notes + ([f"{left} missing points were left empty."] if left else []))


def _typical(sd: Floats) -> float:
    return float(np.sqrt(3 * (sd**2).mean()) * 1e3)


def fill_gaps(
    trajectories: MarkerTrajectories,
    clusters: Sequence[Cluster] = (),
    *,
    ways: Sequence[int] = (SPLINE, FROM_CLUSTER),
    largest_error_m: float = 0.01,
    seed: int = 0,
) -> FilledGaps:
    """Fill gaps by what held-out gaps of the same length show to be the better way, and leave what neither can.

    A spline goes through a marker's own path and fills between two measured points only. The cluster's other markers
    tell where a marker must be by the cluster's shape and its few modes of change, with the rigid motion taken away;
    what they miss at the ends of the gap is taken away in between. For each cluster, gaps of 1, 2, 4, ... frames are
    cut where markers were measured, filled both ways, and compared.

    Args:
        trajectories: With gaps.
        clusters: Whose markers move together; markers of none are filled by a spline.
        ways: SPLINE, FROM_CLUSTER, or both to choose from.
        largest_error_m: A gap stays empty if held-out ones of its length were farther off than this (RMS distance).
        seed: Of the places of held-out gaps; the same seed gives the same result.
    """
    points = np.array(trajectories.points)
    way = np.where(trajectories.present, MEASURED, STILL_MISSING)
    sd = np.full(way.shape, np.nan)
    tables = []
    for name, columns in _groups(trajectories, clusters):
        if trajectories.present[:, columns].all():
            continue
        table = held_out(points[:, columns], name, np.random.default_rng(seed))
        tables.append(table)
        filled = _fill_group(points[:, columns], table, ways, largest_error_m)
        points[:, columns], way[:, columns], sd[:, columns] = filled
    was = trajectories.filled | ((way == SPLINE) | (way == FROM_CLUSTER))
    filled_trajectories = replace(trajectories, points=points, filled=was)
    return FilledGaps(trajectories=filled_trajectories, way=way, sd=sd, held_out=tuple(tables))


def _groups(trajectories: MarkerTrajectories, clusters: Sequence[Cluster]) -> list[tuple[str, list[int]]]:
    """List the columns of each cluster, and those of none under the name ""."""
    groups = [(c.segment, [trajectories.labels.index(label) for label in c.labels]) for c in clusters]
    inside = {column for _, columns in groups for column in columns}
    others = [n for n in range(len(trajectories.labels)) if n not in inside]
    return [*groups, *([("", others)] if others else [])]


def _gaps(points: Floats) -> list[tuple[int, int, int]]:
    """List the gaps of markers (F, M, 3) as (marker, first frame, one after the last)."""
    missing = np.where(np.isfinite(points).all(-1), np.nan, 0.0)
    return [(m, *run) for m in range(points.shape[1]) for run in known_runs(missing[:, m])]


def _fill_group(
    points: Floats, table: HeldOut, ways: Sequence[int], largest_error_m: float
) -> tuple[Floats, np.ndarray, Floats]:
    """Fill the gaps of one group (F, M, 3) and say how and how well."""
    filled, present = points.copy(), np.isfinite(points).all(-1)
    way, sd = np.where(present, MEASURED, STILL_MISSING), np.full(present.shape, np.nan)
    candidates = {SPLINE: spline(points)}
    if np.isfinite(table.cluster_rms).any():
        candidates[FROM_CLUSTER] = from_cluster(points, table.rank)
    for marker, start, end in _gaps(points):
        at_end = start == 0 or end == len(points)
        # At an end of the trial there is a measured point on one side only: as far from it as the middle of twice it.
        able = [way for way in ways if way in candidates and not (at_end and way == SPLINE)]
        best, rms = table.best(2 * (end - start) if at_end else end - start, able) if able else (STILL_MISSING, np.inf)
        if not rms <= largest_error_m:
            continue
        put = candidates[best][start:end, marker]
        done = np.isfinite(put).all(-1)
        filled[start:end, marker][done] = put[done]
        way[start:end, marker][done] = best
        sd[start:end, marker][done] = rms / np.sqrt(3)
    return filled, way, sd


def spline(points: Floats) -> Floats:
    """Put Akima's cubic spline through each marker's known points; NaN before the first and after the last.

    Its slopes come from the nearest points alone ([Akima1970]), so that noise beside a gap does not swing through it.

    Args:
        points: (F, M, 3); NaN where missing.
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
    """Put each marker where the cluster's others say it is, tied to its own path at the ends of each gap.

    Args:
        points: (F, M, 3) of one cluster; NaN where missing.
        rank: Modes of the cluster's change of shape.

    Returns:
        (F, M, 3); NaN in frames with fewer than three markers.
    """
    predicted = predict(points, rank)
    off = points - predicted
    frames = np.arange(len(points))
    for m in range(points.shape[1]):
        known = np.flatnonzero(np.isfinite(off[:, m]).all(-1))
        if len(known):
            off[:, m] = np.stack([np.interp(frames, known, off[known, m, axis]) for axis in range(3)], -1)
    return np.asarray(predicted + off)


def held_out(points: Floats, group: str, rng: np.random.Generator) -> HeldOut:
    """Measure both ways of filling on gaps that are cut into measured paths; of a long trial, in its middle.

    Args:
        points: (F, M, 3) [m] of the markers of one cluster, or of none (`group` is "").
        group: The segment's name.
        rng: Draws the places of the gaps.
    """
    longest = max((end - start for _, start, end in _gaps(points)), default=1)
    points = points[max(0, (len(points) - _STRETCH) // 2) :][:_STRETCH]
    lengths = [n for n in _LENGTHS if n <= _LARGEST_SHARE * len(points) and (n == 1 or n < 4 * longest)] or [1]
    cuts = {n: _cuts(points, n, rng) for n in lengths}
    spline_rms = [_rms(spline, points, cuts[n]) for n in lengths]
    cluster_rms, rank = [np.nan] * len(lengths), 0
    if group and points.shape[1] > NEEDED:
        ranks = [r for r in _RANKS if r <= min(len(points) // 4, points.shape[1])]
        middle = cuts[lengths[len(lengths) // 2]][:1]
        errors = [_rms(partial(from_cluster, rank=r), points, middle) for r in ranks]
        rank = ranks[int(np.nanargmin(errors))] if np.isfinite(errors).any() else 0
        cluster_rms = [_rms(partial(from_cluster, rank=rank), points, cuts[n]) for n in lengths]
    return HeldOut(
        group=group, rank=rank, lengths=np.array(lengths), spline_rms=np.array(spline_rms),
        cluster_rms=np.array(cluster_rms),
    )  # fmt: skip


def _cuts(points: Floats, length: int, rng: np.random.Generator) -> list[Mask]:
    """Choose gaps (F, M) of one length, in as many rounds as it takes to have enough of them."""
    rounds = [_cut(points, length, rng)]
    while len(rounds) < _ROUNDS and rounds[0].any() and sum(cut.sum() for cut in rounds) < _CUTS_ENOUGH * length:
        rounds.append(_cut(points, length, rng))
    return rounds


def _cut(points: Floats, length: int, rng: np.random.Generator) -> Mask:
    """Choose gaps (F, M) of one length among measured points, with a measured point at both ends and markers left."""
    known = np.isfinite(points).all(-1)
    frames, count = known.shape
    cut = np.zeros(known.shape, bool)
    made, most = 0, min(_CUTS, max(1, int(_CUT_SHARE * known.sum() / length)))
    for draw in range(_DRAWS * _CUTS):
        m, start = draw % count, int(rng.integers(1, max(frames - length, 2)))
        window = slice(start - 1, start + length + 1)
        others = cut[start : start + length].sum(1).max(initial=0)
        spared = others < max(1, count // _APART)
        if start + length < frames and (known & ~cut)[window, m].all() and spared:
            cut[start : start + length, m] = True
            made += 1
        if made == most:
            break
    return cut


def _rms(fill: Callable[[Floats], Floats], points: Floats, cuts: Sequence[Mask]) -> float:
    """Give the RMS distance of filled points from the measured ones; NaN where nothing was filled."""
    off = [(fill(np.where(cut[..., None], np.nan, points)) - points)[cut] for cut in cuts]
    squared = (np.concatenate(off) ** 2).sum(-1)
    known = np.isfinite(squared)
    return float(np.sqrt(squared[known].mean())) if known.any() else float("nan")
