"""Which point of one uncalibrated camera is which of another: found from how the points move."""

from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from marey.arrays import Floats, Integers, Mask, frozen
from marey.errors import SettingProblem
from marey.nonrigid.affine_epipolar import epipolar_hypotheses
from marey.nonrigid.completion import complete_tracks
from marey.nonrigid.partial_assignment import best_pairs, pair_probabilities
from marey.nonrigid.view_evidence import FEWEST_PAIRS, PairTracks, pair_evidence

_COMPONENTS = 24
"""Components in time that are kept of the tracks of both cameras."""
_COMPLETING_RANK = 12
_HYPOTHESES = 40
_FINALISTS = 6
_ROUNDS = 20
_LEAST_SEEN = 3
"""A frame in which a camera sees fewer points says nothing."""
_STILL = 6.5
"""Largest square singular value of white noise over the middle one, at most."""
_SHARED = 0.5
"""Share of the points that is thought to be seen by both cameras, before anything is known."""
_DOUBTFUL = 0.95
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
        object.__setattr__(self, "pairs", frozen(self.pairs, np.int64))
        object.__setattr__(self, "alone_first", frozen(self.alone_first, np.int64))
        object.__setattr__(self, "alone_second", frozen(self.alone_second, np.int64))
        object.__setattr__(self, "probability", frozen(self.probability))
        object.__setattr__(self, "score", frozen(self.score))


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
    enough = (_seen(first).sum(1) >= _LEAST_SEEN) & (_seen(second).sum(1) >= _LEAST_SEEN)
    first, second = first[enough], second[enough]
    shape = first.shape[2], second.shape[2]
    own, other = (np.flatnonzero(_seen(tracks).sum(0) >= max(2, 0.1 * len(tracks))) for tracks in (first, second))
    if min(len(own), len(other)) < FEWEST_PAIRS or len(first) < 2:
        return _nothing(shape, TOO_FEW.format(count=FEWEST_PAIRS))
    a, b = _prepared(first[:, :, own]), _prepared(second[:, :, other])
    if not (_moves(a) and _moves(b)):
        return _nothing(shape, NOT_MOVING)
    looks = looks[np.ix_(own, other)] + np.log(_SHARED / ((1 - _SHARED) ** 2 * max(len(own), len(other))))
    answers = _answers(*_components(a, b), looks)
    if not answers or answers[0].total <= 0:
        return _nothing(shape, TOO_FEW.format(count=FEWEST_PAIRS))
    return _told(answers, own, other, shape)


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


def _seen(tracks: Floats) -> Mask:
    return np.asarray(np.isfinite(tracks).all(axis=1))


def _prepared(tracks: Floats) -> Floats:
    """Take the translation out, fill gaps by the tracks' own low rank, and give unit spread."""
    seen = _seen(tracks)
    known = np.where(seen[:, None], tracks, 0)
    if seen.all():
        filled = known - known.mean(2, keepdims=True)
    else:
        low, _ = complete_tracks(known, seen, min(_COMPLETING_RANK, tracks.shape[2] - 2, 2 * len(tracks) - 2))
        middle = ((known - low) * seen[:, None]).sum(2) / seen.sum(1)[:, None]
        filled = np.where(seen[:, None], known - middle[:, :, None], low)
    return np.asarray(filled / max(float(np.sqrt(np.mean(np.sum(filled**2, axis=1)))), 1e-300))


def _moves(tracks: Floats) -> bool:
    """Tell whether points move against each other more than noise does."""
    motion = (tracks - tracks.mean(0)).reshape(len(tracks), -1)
    values = np.linalg.svd(motion, compute_uv=False)[: min(len(tracks) - 1, motion.shape[1] - 4)]
    return bool(values[0] ** 2 > max(_STILL * float(np.median(values**2)), 1e-16 * tracks.size))


def _components(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Give the few components in time (K, 2, P) and (K, 2, Q) that hold the tracks of both cameras."""
    frames, size = len(a), a[0].size
    together = np.concatenate([a.reshape(frames, -1), b.reshape(frames, -1)], axis=1)
    times = np.linalg.svd(together, full_matrices=False)[0][:, :_COMPONENTS]
    few = times.T @ together / np.sqrt(frames)
    return few[:, :size].reshape(-1, 2, a.shape[2]), few[:, size:].reshape(-1, 2, b.shape[2])


def _answers(a: Floats, b: Floats, prior: Floats) -> list[_Answer]:
    """Give answers that differ, the best first."""
    found: list[_Answer] = []
    for start in epipolar_hypotheses(a, b, count=_HYPOTHESES)[:_FINALISTS]:
        for answer in _improved(a, b, start.rows, start.columns, prior):
            if not any(_same(answer, other) for other in found):
                found.append(answer)
    return sorted(found, key=lambda answer: -answer.total)


def _same(one: _Answer, other: _Answer) -> bool:
    return np.array_equal(one.rows, other.rows) and np.array_equal(one.columns, other.columns)


def _judged(a: Floats, b: Floats, rows: Integers, columns: Integers, prior: Floats) -> _Answer:
    score = pair_evidence(PairTracks(a, b, rows, columns)) + prior
    # What the equation's offset, direction and spreads cost that were fitted to these pairs (Schwarz).
    cost = (2 * len(a) + 3) / 2 * float(np.log(len(rows)))
    return _Answer(rows, columns, score, float(score[rows, columns].sum()) - cost)


def _improved(a: Floats, b: Floats, rows: Integers, columns: Integers, prior: Floats) -> list[_Answer]:
    """Judge all pairs by those there are, and choose anew, until nothing helps; give the best and its near rivals."""
    if len(rows) < FEWEST_PAIRS:
        return []
    best = _judged(a, b, rows, columns, prior)
    rivals: list[_Answer] = []
    for _ in range(_ROUNDS):
        rivals = [_judged(a, b, *chosen, prior) for chosen in _alternatives(best) if len(chosen[0]) >= FEWEST_PAIRS]
        better = max(rivals, key=lambda answer: answer.total, default=best)
        if better.total <= best.total:
            break
        best = better
    return [best, *rivals]


def _alternatives(answer: _Answer) -> list[tuple[Integers, Integers]]:
    """Give what the scores would choose; where that is what there is, the same with two partners exchanged."""
    rows, columns = best_pairs(answer.score)
    if not (np.array_equal(rows, answer.rows) and np.array_equal(columns, answer.columns)):
        return [(rows, columns)]
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


def _told(answers: list[_Answer], own: Integers, other: Integers, shape: tuple[int, int]) -> Correspondence:
    """Give the best answer, with probabilities over all of them."""
    best, notes = answers[0], []
    kin = [answer for answer in answers if _shared(answer, best) > 0.5]
    chance = max((answer.total for answer in answers if _shared(answer, best) <= 0.5), default=0.0)
    sure = float(expit((best.total - max(chance, 0.0)) / _SCATTER))
    weight = np.exp([answer.total - best.total for answer in kin])
    tables = [pair_probabilities(answer.score) for answer in kin]
    probability = sure * np.einsum("a,apq->pq", weight / weight.sum(), tables)[best.rows, best.columns]
    pairs = np.stack([own[best.rows], other[best.columns]], axis=1)
    score = np.zeros(shape)
    score[np.ix_(own, other)] = sure * best.score
    if np.min(probability) < _DOUBTFUL:
        notes.append(AMBIGUOUS.format(count=int((probability < _DOUBTFUL).sum()), all=len(pairs)))
    return Correspondence(
        pairs=pairs, probability=probability, score=score,
        alone_first=np.setdiff1d(np.arange(shape[0]), pairs[:, 0]),
        alone_second=np.setdiff1d(np.arange(shape[1]), pairs[:, 1]),
        notes=tuple(notes),
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
