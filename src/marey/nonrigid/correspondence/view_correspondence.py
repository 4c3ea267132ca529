"""Correspondence between the points of two uncalibrated cameras, from their motion."""

from dataclasses import dataclass, field

import numpy as np
from scipy.special import expit

from marey.arrays import Floats, Integers, freeze_fields
from marey.errors import SettingProblem
from marey.nonrigid.correspondence.affine_epipolar import EpipolarSettings, epipolar_hypotheses, same_pairs
from marey.nonrigid.correspondence.partial_assignment import best_pairs, pair_probabilities
from marey.nonrigid.correspondence.track_components import components, full_frames, points_move, prepared, seen_in
from marey.nonrigid.correspondence.view_evidence import FEWEST_PAIRS, PairTracks, pair_evidence

SHARED = 0.5
"""Assumed fraction of the points that both cameras see. Chosen by hand; results were not measured against other
values."""
NOT_MOVING = "In one of the cameras the points do not move relative to each other: motion does not determine the pairs."
"""Note of cameras without relative motion of the points."""
TOO_FEW = "Fewer than {count} points agree between the two cameras more often than by chance: no pair is given."
"""Note of cameras without enough pairs."""
AMBIGUOUS = (
    "{count} of {all} pairs are ambiguous: other partners explain the tracks nearly as well (see the probability)."
)
"""Note of pairs with low probability."""


@dataclass(frozen=True, kw_only=True)
class TrackMatchSettings:
    """Settings of the correspondence between two uncalibrated cameras.

    Where nothing else is stated, defaults were chosen by hand, and results were not measured against other values.
    Scores are log-likelihood ratios [natural logarithm].
    """

    hypotheses: int = 40
    """Number of epipolar equations that are refined."""
    finalists: int = 6
    """Number of epipolar equations whose pairs are evaluated."""
    hopeless: float = 0.25
    """Solutions whose total score is below this fraction of the best are not improved."""
    rounds: int = 20
    """Largest number of improvements of a solution."""
    well_seen: float = 0.5
    """Points seen in a smaller fraction of the frames are matched after the others, in the frames in which they are
    seen."""
    seen_in_window: float = 0.9
    """Least fraction of the frames of a window in which a point must be seen to be matched in it."""
    shortest_window: int = 6
    """Shortest window [frames]."""
    ambiguous: float = 0.95
    """Pairs with a lower probability are reported."""
    leniencies: tuple[float, ...] = (1.0, 4.0, 16.0, 64.0, 256.0)
    """Factors of the residuals' variance with which pairs are proposed."""
    exchanges: int = 8
    """Number of exchanges of two partners that are tried at once."""
    close: float = 15.0
    """Exchanges that lower the score by more are not tried."""
    scatter: float = 10.0
    """Standard deviation of the total scores of wrong solutions."""
    same_solution: float = 0.5
    """Solutions that share more than this fraction of the pairs count as variants of the same one."""
    epipolar: EpipolarSettings = field(default_factory=EpipolarSettings)
    """Settings of the search for the epipolar equation."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Correspondence:
    """Pairs of points of two cameras."""

    pairs: Integers
    """(N, 2) point of the first and point of the second camera."""
    probability: Floats
    """(N,) probability that the pair is correct."""
    alone_first: Integers
    """(n,) points of the first camera without a partner."""
    alone_second: Integers
    """(m,) points of the second camera without a partner."""
    score: Floats
    """(P, Q) log-likelihood ratio that two points are the same, given the other pairs; 0 where unknown."""
    notes: tuple[str, ...]
    """Notes for the user."""

    def __post_init__(self) -> None:
        freeze_fields(self, "pairs", "alone_first", "alone_second", dtype=np.int64)
        freeze_fields(self, "probability", "score")


@dataclass(frozen=True, eq=False)
class _Solution:
    """Pairs with their scores."""

    rows: Integers
    columns: Integers
    score: Floats
    """(P, Q) scores given these pairs."""
    total: float
    """Sum of the pairs' scores, minus the cost of the fitted parameters."""


def match_tracks(
    first: Floats,
    second: Floats,
    appearance: Floats | None = None,
    settings: TrackMatchSettings = TrackMatchSettings(),
) -> Correspondence:
    """Match the tracks of two fixed, synchronised, uncalibrated cameras.

    Unlike the paper, which leaves the correspondence to the user ([Alexander2003] section 2.5): two pairs of points
    determine the affine epipolar equation between the cameras for all frames at once. The equation that most points
    satisfy is found, and pairs are then evaluated by it and by the common subspace of both cameras' tracks.

    Args:
        first: (F, 2, P) tracks of one camera; NaN where a point is not seen.
        second: (F, 2, Q) tracks of the other camera at the same instants; units may differ.
        appearance: (P, Q) log-likelihood ratio that two points are the same, from their appearance; 0 where unknown.
        settings: Tuned constants.

    Returns:
        The pairs, and the points without a partner.

    Raises:
        SettingProblem: The shapes of the arrays do not match, or the appearance is not finite.
    """
    first, second = np.asarray(first, float), np.asarray(second, float)
    looks = _checked(first, second, appearance)
    enough = full_frames(first) & full_frames(second)
    first, second = first[enough], second[enough]
    shape = first.shape[2], second.shape[2]
    own, other = _well_seen(first, settings), _well_seen(second, settings)
    if min(len(own), len(other)) < FEWEST_PAIRS or len(first) < 2:
        return _nothing(shape, TOO_FEW.format(count=FEWEST_PAIRS))
    a, b = prepared(first[:, :, own]), prepared(second[:, :, other])
    if not (points_move(a) and points_move(b)):
        return _nothing(shape, NOT_MOVING)
    prior = float(np.log(SHARED / ((1 - SHARED) ** 2 * max(len(own), len(other)))))
    solutions = _solutions(*components(a, b), looks[np.ix_(own, other)], prior, settings)
    if not solutions or solutions[0].total <= 0:
        return _nothing(shape, TOO_FEW.format(count=FEWEST_PAIRS))
    late = _late_scores(first, second, solutions[0], (own, other), looks + prior, settings)
    return _correspondence(solutions, own, other, late, settings)


def _well_seen(tracks: Floats, settings: TrackMatchSettings) -> Integers:
    """Find the points that are seen in most frames, at least half of all points."""
    share = seen_in(tracks).mean(axis=0) if len(tracks) else np.zeros(tracks.shape[2])
    return np.flatnonzero((share > 0) & (share >= min(settings.well_seen, float(np.median(share)))))


def _late_scores(
    first: Floats,
    second: Floats,
    best: _Solution,
    chosen: tuple[Integers, Integers],
    prior: Floats,
    settings: TrackMatchSettings,
) -> Floats:
    """Compute scores (P, Q) of points that are seen for part of the time only; NaN where not evaluated.

    Among windows of half the sequence, then of a quarter, the first in which both points are seen is used.
    """
    own, other = chosen
    score = np.full(prior.shape, np.nan)
    rows, columns = own[best.rows], other[best.columns]
    late = np.ones(prior.shape, bool)
    late[np.ix_(own, other)] = False
    late[rows], late[:, columns] = False, False
    for window in _windows(len(first), settings.shortest_window):
        shares = (seen_in(tracks[window]).mean(axis=0) for tracks in (first, second))
        here, there = (np.flatnonzero(share >= settings.seen_in_window) for share in shares)
        both = np.isin(rows, here) & np.isin(columns, there)
        wanted = np.ix_(here, there)
        if both.sum() < FEWEST_PAIRS or not np.any(late[wanted] & np.isnan(score[wanted])):
            continue
        few = components(prepared(first[window][:, :, here]), prepared(second[window][:, :, there]))
        known = np.searchsorted(here, rows[both]), np.searchsorted(there, columns[both])
        found = pair_evidence(PairTracks(*few, *known)) + prior[wanted]
        score[wanted] = np.where(late[wanted] & np.isnan(score[wanted]), found, score[wanted])
    return score


def _windows(frames: int, shortest: int) -> list[slice]:
    """List windows of half the frames, then of a quarter, each starting in the middle of the previous one."""
    lengths = [length for length in (frames // 2, frames // 4) if length >= shortest]
    return [slice(a, a + n) for n in lengths for a in (*range(0, frames - n, max(1, n // 2)), frames - n)]


def check_views(first: Floats, second: Floats, appearance: Floats | None) -> tuple[int, int]:
    """Check the shapes of the tracks of two cameras and of their appearance.

    Returns:
        Numbers of points of the two cameras, P and Q.

    Raises:
        SettingProblem: A shape is wrong, or the numbers of frames differ.
    """
    for tracks in (first, second):
        if tracks.ndim != 3 or tracks.shape[1] != 2:
            raise SettingProblem(f"Tracks have shape {tracks.shape}; expected those of one view (frames, 2, points).")
    if len(first) != len(second):
        raise SettingProblem(f"The cameras have {len(first)} and {len(second)} frames; they must be the same instants.")
    shape = first.shape[2], second.shape[2]
    if appearance is not None and np.shape(appearance) != shape:
        raise SettingProblem(f"The appearance has shape {np.shape(appearance)}; expected {shape}.")
    return shape


def _checked(first: Floats, second: Floats, appearance: Floats | None) -> Floats:
    shape = check_views(first, second, appearance)
    looks = np.zeros(shape) if appearance is None else np.asarray(appearance, float)
    if not np.all(np.isfinite(looks)):
        raise SettingProblem("The appearance contains values that are not finite; expected log-likelihood ratios.")
    return looks


def _solutions(a: Floats, b: Floats, looks: Floats, prior: float, settings: TrackMatchSettings) -> list[_Solution]:
    """Find distinct solutions, the best first."""
    found: list[_Solution] = []
    starts = epipolar_hypotheses(a, b, count=settings.hypotheses, looks=looks, settings=settings.epipolar)
    starts = [start for start in starts[: settings.finalists] if len(start.rows) >= FEWEST_PAIRS]
    evaluated = [_evaluated(a, b, start.rows, start.columns, looks + prior) for start in starts]
    for solution in sorted(evaluated, key=lambda solution: -solution.total):
        # Solutions far worse than the best one only show the scores that occur by chance.
        hopeless = bool(found) and solution.total < settings.hopeless * found[0].total
        for better in [solution] if hopeless else _improved(a, b, solution, looks + prior, settings):
            if not any(same_pairs(better, other) for other in found):
                found.append(better)
        found.sort(key=lambda solution: -solution.total)
    return found


def _evaluated(a: Floats, b: Floats, rows: Integers, columns: Integers, prior: Floats) -> _Solution:
    """Compute the scores given some pairs."""
    score = pair_evidence(PairTracks(a, b, rows, columns)) + prior
    # Cost of the fitted parameters: the equation's offset, direction and variances (Schwarz criterion).
    cost = (2 * len(a) + 3) / 2 * float(np.log(len(rows)))
    return _Solution(rows, columns, score, float(score[rows, columns].sum()) - cost)


def _improved(a: Floats, b: Floats, best: _Solution, prior: Floats, settings: TrackMatchSettings) -> list[_Solution]:
    """Choose pairs again by the scores given the current ones until convergence; return the best and its rivals."""
    rivals: list[_Solution] = []
    for _ in range(settings.rounds):
        for propose in (_rechosen, _exchanged):
            rivals = [_evaluated(a, b, *chosen, prior) for chosen in propose(a, b, best, prior, settings)]
            better = max(rivals, key=lambda solution: solution.total, default=best)
            if better.total > best.total:
                break
        else:
            return [best, *rivals]
        best = better
    return [best, *rivals]


def _rechosen(
    a: Floats, b: Floats, current: _Solution, prior: Floats, settings: TrackMatchSettings
) -> list[tuple[Integers, Integers]]:
    """Propose the best pairs by the scores, also with larger variances of the residuals."""
    found: list[tuple[Integers, Integers]] = []
    for leniency in settings.leniencies:
        score = current.score
        if leniency > 1:
            score = pair_evidence(PairTracks(a, b, current.rows, current.columns), leniency=leniency) + prior
        rows, columns = best_pairs(score)
        known = [(current.rows, current.columns), *found]
        if len(rows) >= FEWEST_PAIRS and not any(
            np.array_equal(rows, r) and np.array_equal(columns, c) for r, c in known
        ):
            found.append((rows, columns))
    return found


def _exchanged(
    a: Floats, b: Floats, current: _Solution, prior: Floats, settings: TrackMatchSettings
) -> list[tuple[Integers, Integers]]:
    """Propose the current pairs with two partners exchanged, where that lowers the score little."""
    rows, columns = current.rows, current.columns
    between = current.score[np.ix_(rows, columns)]
    own = np.diagonal(between)
    loss = own[:, None] + own - between - between.T
    loss[np.tril_indices(len(rows))] = np.inf
    found = []
    for index in np.argsort(loss, axis=None)[: settings.exchanges]:
        i, j = np.unravel_index(index, loss.shape)
        if loss[i, j] < settings.close:
            exchanged = columns.copy()
            exchanged[[i, j]] = columns[[j, i]]
            found.append((rows, exchanged))
    return found


def _correspondence(
    solutions: list[_Solution], own: Integers, other: Integers, late: Floats, settings: TrackMatchSettings
) -> Correspondence:
    """Combine the best solution with the points seen for part of the time, and compute probabilities."""
    best, same = solutions[0], settings.same_solution
    kin = [solution for solution in solutions if _shared(solution, best) > same]
    chance = max((solution.total for solution in solutions if _shared(solution, best) <= same), default=0.0)
    sure = float(expit((best.total - max(chance, 0.0)) / settings.scatter))
    weight = np.exp([solution.total - best.total for solution in kin])
    tables = [pair_probabilities(solution.score) for solution in kin]
    table = np.einsum("a,apq->pq", weight / weight.sum(), tables)
    score = np.where(np.isnan(late), 0, late)
    more = best_pairs(score)
    score[np.ix_(own, other)] = best.score
    pairs = np.concatenate([np.stack([own[best.rows], other[best.columns]], 1), np.stack(more, 1)])
    later = pair_probabilities(np.where(np.isnan(late), -np.inf, late))[more]
    probability = sure * np.concatenate([table[best.rows, best.columns], later])
    ambiguous = int((probability < settings.ambiguous).sum())
    return Correspondence(
        pairs=pairs, probability=probability, score=sure * score,
        alone_first=np.setdiff1d(np.arange(len(score)), pairs[:, 0]),
        alone_second=np.setdiff1d(np.arange(score.shape[1]), pairs[:, 1]),
        notes=(AMBIGUOUS.format(count=ambiguous, all=len(pairs)),) if ambiguous else (),
    )  # fmt: skip


def _shared(one: _Solution, other: _Solution) -> float:
    """Compute the fraction of the pairs that two solutions share."""
    both = set(zip(one.rows, one.columns, strict=True)) & set(zip(other.rows, other.columns, strict=True))
    return len(both) / max(1, min(len(one.rows), len(other.rows)))


def _nothing(shape: tuple[int, int], note: str) -> Correspondence:
    return Correspondence(
        pairs=np.empty((0, 2), np.int64), probability=np.empty(0), score=np.zeros(shape),
        alone_first=np.arange(shape[0]), alone_second=np.arange(shape[1]), notes=(note,),
    )  # fmt: skip
