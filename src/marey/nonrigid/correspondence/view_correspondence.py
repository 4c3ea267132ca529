"""Which point of one uncalibrated camera is which of another: found from how the points move."""

from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from marey.arrays import Floats, Integers, freeze_fields
from marey.errors import SettingProblem
from marey.nonrigid.correspondence.affine_epipolar import epipolar_hypotheses
from marey.nonrigid.correspondence.partial_assignment import best_pairs, pair_probabilities
from marey.nonrigid.correspondence.track_components import components, full_frames, moves, prepared, seen_in
from marey.nonrigid.correspondence.view_evidence import FEWEST_PAIRS, PairTracks, pair_evidence

_HYPOTHESES = 40
_FINALISTS = 6
_HOPELESS = 0.25
"""Answers whose total is below this share of the best one's are not improved."""
_ROUNDS = 20
_WELL_SEEN = 0.5
"""Points that are seen in a smaller share of the frames are judged only after the others, by the time they are seen."""
_SEEN_IN_WINDOW = 0.9
_SHORTEST = 6
"""Shorter windows tell too little [frames]."""
_SHARED = 0.5
"""Share of the points that is thought to be seen by both cameras, before anything is known."""
_DOUBTFUL = 0.95
_LENIENCIES = (1.0, 4.0, 16.0, 64.0, 256.0)
_EXCHANGES = 8
"""Exchanges of two partners that are tried at once."""
_CLOSE = 15.0
"""Exchanges that would lower the score by more are not tried [natural logarithm]."""
_SCATTER = 10.0
"""By how much totals of wrong answers differ by chance [natural logarithm]."""
NOT_MOVING = "In one of the cameras the points do not move against each other: nothing tells which is which."
TOO_FEW = "No {count} points or more agree between the two cameras beyond chance: no pair is given."
AMBIGUOUS = (
    "{count} of {all} pairs are not sure: other partners explain the tracks nearly as well (see the probability)."
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Correspondence:
    """Pairs of points of two cameras."""

    pairs: Integers
    """(N, 2) point of the first and point of the second camera."""
    probability: Floats
    """(N,) that the pair is right."""
    alone_first: Integers
    """(n,) points of the first camera without a partner."""
    alone_second: Integers
    """(m,) points of the second camera without a partner."""
    score: Floats
    """(P, Q) logarithm of how much more probable one point is than two, given the other pairs; 0 where nothing is
    known."""
    notes: tuple[str, ...]
    """What a user should know of this answer."""

    def __post_init__(self) -> None:
        freeze_fields(self, "pairs", "alone_first", "alone_second", dtype=np.int64)
        freeze_fields(self, "probability", "score")


@dataclass(frozen=True, eq=False)
class _Answer:
    rows: Integers
    columns: Integers
    score: Floats
    """(P, Q) given these pairs."""
    total: float
    """Of the pairs' scores, less the price of what was fitted to them."""


def match_tracks(first: Floats, second: Floats, appearance: Floats | None = None) -> Correspondence:
    """Find which tracks of two fixed, synchronised, uncalibrated cameras show the same points.

    The paper leaves this to the user's hand ([Alexander2003] section 2.5). Ours: two pairs of points fix the affine
    epipolar equation between the cameras through all frames at once; the equation that most points satisfy is found,
    and pairs are then judged by it and by the subspace that both cameras' tracks span together.

    Args:
        first: (F, 2, P) tracks of one camera, NaN where a point is not seen.
        second: (F, 2, Q) those of the other; the frames are the same instants. Units may differ.
        appearance: (P, Q) logarithm of how much more alike two points look than two different ones do, for one and the
            same point; 0 says nothing.

    Returns:
        The pairs, with the points that have no partner.

    Raises:
        SettingProblem: The arrays do not fit together, or there are too few points or frames.
    """
    first, second = np.asarray(first, float), np.asarray(second, float)
    looks = _checked(first, second, appearance)
    enough = full_frames(first) & full_frames(second)
    first, second = first[enough], second[enough]
    shape = first.shape[2], second.shape[2]
    own, other = _well_seen(first), _well_seen(second)
    if min(len(own), len(other)) < FEWEST_PAIRS or len(first) < 2:
        return _nothing(shape, TOO_FEW.format(count=FEWEST_PAIRS))
    a, b = prepared(first[:, :, own]), prepared(second[:, :, other])
    if not (moves(a) and moves(b)):
        return _nothing(shape, NOT_MOVING)
    prior = float(np.log(_SHARED / ((1 - _SHARED) ** 2 * max(len(own), len(other)))))
    answers = _answers(*components(a, b), looks[np.ix_(own, other)], prior)
    if not answers or answers[0].total <= 0:
        return _nothing(shape, TOO_FEW.format(count=FEWEST_PAIRS))
    return _told(answers, own, other, _late_scores(first, second, answers[0], own, other, looks + prior))


def _well_seen(tracks: Floats) -> Integers:
    """Give the points that are seen in most frames, at least half of all."""
    share = seen_in(tracks).mean(axis=0) if len(tracks) else np.zeros(tracks.shape[2])
    return np.flatnonzero((share > 0) & (share >= min(_WELL_SEEN, float(np.median(share)))))


def _late_scores(first: Floats, second: Floats, best: _Answer, own: Integers, other: Integers, prior: Floats) -> Floats:
    """Judge points that are seen for a part of the time, by that part; give scores (P, Q), NaN where not judged.

    Of the windows of half the time, then of a quarter, the first counts in which both points are seen.
    """
    score = np.full(prior.shape, np.nan)
    rows, columns = own[best.rows], other[best.columns]
    late = np.ones(prior.shape, bool)
    late[np.ix_(own, other)] = False
    late[rows], late[:, columns] = False, False
    for window in _windows(len(first)):
        here, there = (np.flatnonzero(seen_in(t[window]).mean(axis=0) >= _SEEN_IN_WINDOW) for t in (first, second))
        both = np.isin(rows, here) & np.isin(columns, there)
        wanted = np.ix_(here, there)
        if both.sum() < FEWEST_PAIRS or not np.any(late[wanted] & np.isnan(score[wanted])):
            continue
        few = components(prepared(first[window][:, :, here]), prepared(second[window][:, :, there]))
        known = np.searchsorted(here, rows[both]), np.searchsorted(there, columns[both])
        found = pair_evidence(PairTracks(*few, *known)) + prior[wanted]
        score[wanted] = np.where(late[wanted] & np.isnan(score[wanted]), found, score[wanted])
    return score


def _windows(frames: int) -> list[slice]:
    """Give windows of half the frames, and of a quarter, each begun in the middle of the one before."""
    lengths = [length for length in (frames // 2, frames // 4) if length >= _SHORTEST]
    return [slice(a, a + n) for n in lengths for a in (*range(0, frames - n, max(1, n // 2)), frames - n)]


def _checked(first: Floats, second: Floats, appearance: Floats | None) -> Floats:
    for tracks in (first, second):
        if tracks.ndim != 3 or tracks.shape[1] != 2:
            raise SettingProblem(f"Tracks of shape {tracks.shape} are none of one view (frames, 2, points).")
    if len(first) != len(second):
        raise SettingProblem(f"The cameras have {len(first)} and {len(second)} frames; they must be the same instants.")
    shape = first.shape[2], second.shape[2]
    looks = np.zeros(shape) if appearance is None else np.asarray(appearance, float)
    if looks.shape != shape or not np.all(np.isfinite(looks)):
        raise SettingProblem(f"What points look like must be finite and of shape {shape}, not {looks.shape}.")
    return looks


def _answers(a: Floats, b: Floats, looks: Floats, prior: float) -> list[_Answer]:
    """Give answers that differ, the best first."""
    found: list[_Answer] = []
    starts = epipolar_hypotheses(a, b, count=_HYPOTHESES, looks=looks)[:_FINALISTS]
    judged = [_judged(a, b, s.rows, s.columns, looks + prior) for s in starts if len(s.rows) >= FEWEST_PAIRS]
    for answer in sorted(judged, key=lambda answer: -answer.total):
        # What comes nowhere near the best so far only tells what chance can do.
        hopeless = bool(found) and answer.total < _HOPELESS * found[0].total
        for better in [answer] if hopeless else _improved(a, b, answer, looks + prior):
            if not any(_same(better, other) for other in found):
                found.append(better)
        found.sort(key=lambda answer: -answer.total)
    return found


def _same(one: _Answer, other: _Answer) -> bool:
    return np.array_equal(one.rows, other.rows) and np.array_equal(one.columns, other.columns)


def _judged(a: Floats, b: Floats, rows: Integers, columns: Integers, prior: Floats) -> _Answer:
    score = pair_evidence(PairTracks(a, b, rows, columns)) + prior
    # What the equation's offset, direction and spreads cost that were fitted to these pairs (Schwarz).
    cost = (2 * len(a) + 3) / 2 * float(np.log(len(rows)))
    return _Answer(rows, columns, score, float(score[rows, columns].sum()) - cost)


def _improved(a: Floats, b: Floats, best: _Answer, prior: Floats) -> list[_Answer]:
    """Judge all pairs by those there are, and choose anew, until nothing helps; give the best and its near rivals."""
    rivals: list[_Answer] = []
    for _ in range(_ROUNDS):
        for propose in (_rechosen, _exchanged):
            rivals = [_judged(a, b, *chosen, prior) for chosen in propose(a, b, best, prior)]
            better = max(rivals, key=lambda answer: answer.total, default=best)
            if better.total > best.total:
                break
        else:
            return [best, *rivals]
        best = better
    return [best, *rivals]


def _rechosen(a: Floats, b: Floats, answer: _Answer, prior: Floats) -> list[tuple[Integers, Integers]]:
    """Give what the scores would choose, also when the pairs there are judge the others less hard."""
    found: list[tuple[Integers, Integers]] = []
    for leniency in _LENIENCIES:
        score = answer.score
        if leniency > 1:
            score = pair_evidence(PairTracks(a, b, answer.rows, answer.columns), leniency=leniency) + prior
        rows, columns = best_pairs(score)
        known = [(answer.rows, answer.columns), *found]
        if len(rows) >= FEWEST_PAIRS and not any(
            np.array_equal(rows, r) and np.array_equal(columns, c) for r, c in known
        ):
            found.append((rows, columns))
    return found


def _exchanged(a: Floats, b: Floats, answer: _Answer, prior: Floats) -> list[tuple[Integers, Integers]]:
    """Give the pairs there are with two partners exchanged, where that costs little."""
    rows, columns = answer.rows, answer.columns
    between = answer.score[np.ix_(rows, columns)]
    own = np.diagonal(between)
    loss = own[:, None] + own - between - between.T
    loss[np.tril_indices(len(rows))] = np.inf
    found = []
    for index in np.argsort(loss, axis=None)[:_EXCHANGES]:
        i, j = np.unravel_index(index, loss.shape)
        if loss[i, j] < _CLOSE:
            exchanged = columns.copy()
            exchanged[[i, j]] = columns[[j, i]]
            found.append((rows, exchanged))
    return found


def _told(answers: list[_Answer], own: Integers, other: Integers, late: Floats) -> Correspondence:
    """Give the best answer with those seen for a part of the time, and probabilities."""
    best = answers[0]
    kin = [answer for answer in answers if _shared(answer, best) > 0.5]
    chance = max((answer.total for answer in answers if _shared(answer, best) <= 0.5), default=0.0)
    sure = float(expit((best.total - max(chance, 0.0)) / _SCATTER))
    weight = np.exp([answer.total - best.total for answer in kin])
    tables = [pair_probabilities(answer.score) for answer in kin]
    table = np.einsum("a,apq->pq", weight / weight.sum(), tables)
    score = np.where(np.isnan(late), 0, late)
    more = best_pairs(score)
    score[np.ix_(own, other)] = best.score
    pairs = np.concatenate([np.stack([own[best.rows], other[best.columns]], 1), np.stack(more, 1)])
    later = pair_probabilities(np.where(np.isnan(late), -np.inf, late))[more]
    probability = sure * np.concatenate([table[best.rows, best.columns], later])
    doubtful = int((probability < _DOUBTFUL).sum())
    return Correspondence(
        pairs=pairs, probability=probability, score=sure * score,
        alone_first=np.setdiff1d(np.arange(len(score)), pairs[:, 0]),
        alone_second=np.setdiff1d(np.arange(score.shape[1]), pairs[:, 1]),
        notes=(AMBIGUOUS.format(count=doubtful, all=len(pairs)),) if doubtful else (),
    )  # fmt: skip


def _shared(one: _Answer, other: _Answer) -> float:
    """Give the share of the pairs of two answers that both have."""
    both = set(zip(one.rows, one.columns, strict=True)) & set(zip(other.rows, other.columns, strict=True))
    return len(both) / max(1, min(len(one.rows), len(other.rows)))


def _nothing(shape: tuple[int, int], note: str) -> Correspondence:
    return Correspondence(
        pairs=np.empty((0, 2), np.int64), probability=np.empty(0), score=np.zeros(shape),
        alone_first=np.arange(shape[0]), alone_second=np.arange(shape[1]), notes=(note,),
    )  # fmt: skip
