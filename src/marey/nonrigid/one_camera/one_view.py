"""Shape and motion of a deforming object from the tracks of one uncalibrated camera ([Alexander2003] eq. (9)-(12)).

Unlike the paper, which leaves the number of basis shapes and the metric upgrade open, the answer with the best evidence
is taken: rotations for several numbers of shapes, each also with steadier camera paths, are judged by how probable they
make the tracks under one Gaussian model of a deforming shape, and the best is refined by that model.
"""

from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.errors import MareyError, SettingProblem
from marey.geometry import rotations
from marey.nonrigid.core.completion import complete_tracks, singular_vectors
from marey.nonrigid.core.deforming_model import DeformingModel, basis_cost, begin, improve, keep_modes, shape_variance
from marey.nonrigid.core.kept_lengths import choose_lengths
from marey.nonrigid.core.metric_upgrade import rotation_candidates
from marey.nonrigid.core.rotation_paths import accelerations, mirrored_after, steadier
from marey.nonrigid.core.slow_turns import slow_turn_covariance, turned_covariance
from marey.nonrigid.core.smooth_shapes import nuclear_norm, smooth_shapes
from marey.nonrigid.core.track_checks import RIGID, checked
from marey.nonrigid.in_space.rank import significant_singular_values

FEWEST_FRAMES = 6
FEWEST_POINTS = 4
"""That a frame must show."""
FEWEST_IN_ALL = 7
"""Fewer points have too few singular values to tell depth from noise."""
COMPLETING_RANK = 15
SPANS = (0.0, 1.0, 1e2, 1e4, 1e6, 1e8, 1e10)
"""Weights of the camera's steadiness that are tried, see `steadier`."""
TOLD_APART = 0.01
"""Of camera paths whose evidence differs by less, in natural logarithms a coordinate of the tracks, the steadiest is
taken: a slow turn that the object makes as a whole and one of the camera look alike, and the evidence tells little."""
CREDIBLE = 0.002
"""How fast belief in an answer falls: by a factor e for this much evidence a coordinate. Not one over the number of
coordinates: what a model leaves of the shapes is alike over many frames and points, and is no independent evidence."""
BEST_OF_SPAN = 3
"""Numbers of basis shapes that the model compares at last; the nuclear norm chooses them."""
JUDGING_NOISE = 0.01
"""Noise that is believed at least when answers are compared, as a share of the object's size: what few modes leave is
not noise, and would decide otherwise."""
JUDGING_MODES = 12
JUDGING_ROUNDS = 10
MODES = (3, 6, 12, 20, 36)
"""Numbers of modes with which the answer is refined; one is told."""
PRICE = 0.3
"""Share of `basis_cost` that a refined answer pays for its modes. All of it (near the Bayesian information criterion) 
keeps fewer modes than are of use, none of it too many of a simple shape (docs/nonrigid-methods.md)."""
PRICE_OF_DEFORMING = 0.75
"""The same share, to be worth more than a rigid object: noise alone fills modes that are worth up to half of theirs,
13 frames of real skin may be worth no more than all of it."""
FRAMES_A_MODE = 8
"""Fewer frames a mode would tell too little about it."""
ROUNDS = 12
LENGTH_ROUNDS = 8
"""Rounds with distances that are kept, before these are chosen anew."""
MOST_CHOICES = 4
"""How often they are chosen at most."""
SETTLED = 2e-3
"""Change of the shapes between two choices, as a share of the object's size, below which it is enough."""
FIRST_NOISE = 0.005
EXACT = 1e-9
"""Singular values below this share of the largest are none."""
IDLE = 1e-5
"""A mode whose weights are below this share of the object's size does nothing."""
WORTH_A_NOTE = 0.5
"""Doubt about the camera's path [degrees] that is said."""
KEPT = 1e-3
"""A mode whose weights are below this share of the object's size is not told."""


@dataclass(frozen=True, eq=False, kw_only=True)
class NonRigidShapes:
    """Shapes and motion before one camera: tracks = the first two rows of rotation @ shape, + translation.

    What one orthographic camera cannot tell is chosen: the sign of depth (of the two mirror images the one whose first
    frame has its third row along +z by a cross product), the distance, and the object's axes, which are
    the camera's in the first frame. Lengths are in the tracks' unit (pixels): the scale in space is not known.
    """

    shape: Floats
    """(F, 3, P) in the object's frame, also of points that were not seen (`predicted`)."""
    shape_sd: Floats
    """(F, 3, P)."""
    rotation: Floats
    """(F, 3, 3) camera from object."""
    rotation_sd: Floats
    """(F, 3) of the turn about the camera's axes [rad]."""
    translation: Floats
    """(F, 2)."""
    basis: Floats
    """(K, 3, P) the mean shape, and displacements of root mean square 1 a point, the largest first."""
    coefficients: Floats
    """(F, K) weights; the first is 1."""
    noise_sd: float
    """Standard deviation of a coordinate of the tracks about the model."""
    residuals: Floats
    """(F, P) distance of a seen point from the model; NaN where not seen."""
    predicted: Mask
    """(F, P) true where the shape of a point is given that was not seen."""
    steadiness: float
    """Which of `SPANS` was chosen for the camera's path."""
    rank_curve: Floats
    """(n, 2) numbers of basis shapes K that were tried, and what speaks against each: minus the logarithm of the
    tracks' probability and a price of its shapes, a coordinate. The least is taken, less shapes that do nothing; K = 1,
    a rigid object, already where the others would not win at a higher price (`PRICE_OF_DEFORMING`)."""
    path_doubt: Floats
    """(F, 3) how far camera paths of another steadiness that explain the tracks nearly as well turn away from this one,
    root mean square [rad]. The standard deviations are given for a camera as steady as this one; this comes on top."""
    notes: tuple[str, ...]
    """What a user should know of this answer."""

    def __post_init__(self) -> None:
        names = (
            "shape",
            "shape_sd",
            "rotation",
            "rotation_sd",
            "translation",
            "basis",
            "coefficients",
            "residuals",
            "rank_curve",
        )
        freeze_fields(self, *names)
        freeze_fields(self, "predicted", dtype=bool)

    @property
    def rank(self) -> int:
        """K, the number of basis shapes with the mean."""
        return len(self.basis)

    @property
    def point_rms(self) -> Floats:
        """(P,) root mean square distance of each point from the model."""
        return np.asarray(np.sqrt(np.nanmean(self.residuals**2, 0)))


@dataclass
class _Answer:
    """One answer among several, and what speaks for it."""

    rotation: Floats
    """The path it began with."""
    shapes: Floats
    """(F, 3, P) in closed form for that path."""
    span: float
    model: DeformingModel
    cost: float


def factorise_tracks(tracks: Floats, *, rank: int | None = None) -> NonRigidShapes:
    """Find shapes, rotations and basis shapes from the tracks of one camera, orthographic and of one scale.

    Args:
        tracks: (F, 2, P) in any unit; NaN where a point is not seen.
        rank: K, the number of basis shapes with the mean; None chooses it.

    Returns:
        The shapes.

    Raises:
        SettingProblem: The rank is no number of basis shapes that so many frames can tell.
        MareyError: There are too few frames or points, a frame or point is never seen, or the camera sees the object
            from one side only.
    """
    tracks = np.asarray(tracks, float)
    seen = _checked(tracks)
    numbers = _numbers_of_modes(len(tracks), rank)
    weight = seen.astype(float)
    known = np.where(seen[:, None], tracks, 0)
    middle = known.sum(2) / weight.sum(1)[:, None]
    known = np.where(seen[:, None], known - middle[:, :, None], 0)
    size = float(np.sqrt((known**2).sum() / (2 * weight.sum())))
    if size == 0:
        raise MareyError("All points lie in one place in every frame: there is nothing to see.")
    known = known / size
    complete, noise = (known, 0.0) if seen.all() else complete_tracks(known, seen, COMPLETING_RANK)
    notes = _told_by_rank(complete, noise)
    best, judged = _judge(known, weight, complete)
    tried = _refined(known, weight, best, [0, *numbers] if rank is None else numbers, max(noise, FIRST_NOISE))
    rivals = [answer for answer in judged if answer.span == best.span]
    rivals, refined = ([], tried[:1]) if _is_rigid(tried) else (rivals, [a for a in tried if len(a.model.modes)])
    model = copy(min(refined, key=lambda answer: answer.cost).model)
    _hold_lengths(model, known, weight)
    coordinates = 2 * float(weight.sum())
    doubt = [_doubt(model, answers, coordinates) for answers in (rivals, refined) if answers]
    found = _tell(model, weight, doubt, tracks, size, middle)
    curve = [(1 + len(answer.model.modes), answer.cost / coordinates) for answer in tried]
    enough = min(answer.cost for answer in judged) + TOLD_APART * coordinates
    others = [answer for answer in judged if answer.span != best.span and answer.cost <= enough]
    path_doubt = np.sqrt(_doubt(model, others, np.inf)[1]) if others else np.zeros((len(tracks), 3))
    found = replace(found, steadiness=best.span, rank_curve=np.array(curve), path_doubt=path_doubt)
    return replace(found, notes=(*notes, *_told_by_answer(found)))


def _told_by_answer(found: NonRigidShapes) -> list[str]:
    notes = []
    doubt = float(np.degrees(np.sqrt((found.path_doubt**2).sum(1).mean())))
    if doubt > WORTH_A_NOTE and doubt > 2 * np.degrees(np.sqrt((found.rotation_sd**2).sum(1).mean())):
        notes.append(
            f"Camera paths that differ from this one by {doubt:.1f} degrees explain the tracks nearly as well: which "
            "part of a slow turn is the camera's and which the object's is not told. The steadiest path is given, and "
            "standard deviations that hold for a camera as steady as that."
        )
    return [*notes, RIGID] if found.rank == 1 else notes


def _checked(tracks: Floats) -> Mask:
    if tracks.ndim != 3:
        raise MareyError(f"Tracks have the shape {tracks.shape} and should have (frames, 2, points).")
    seen = checked(tracks, points=FEWEST_POINTS, frames=FEWEST_FRAMES)
    if tracks.shape[2] < FEWEST_IN_ALL:
        raise MareyError(
            f"{tracks.shape[2]} points are too few for one camera: {FEWEST_IN_ALL} are needed to tell depth from noise."
        )
    return seen


def _told_by_rank(complete: Floats, noise: float) -> tuple[str, ...]:
    """Say what the singular values tell beforehand: no parallax (an error), or a flat basis shape."""
    frames, _, points = complete.shape
    values = np.linalg.svd(complete.reshape(2 * frames, points), compute_uv=False)
    least = max(EXACT * values[0], noise * (np.sqrt(2 * frames) + np.sqrt(points)))
    if values[2] < least or significant_singular_values(values[:-1], (2 * frames, points - 1)) < 3:
        raise MareyError(
            "The tracks move as a flat picture does: the camera sees the object from one side only, "
            "and depth cannot be told."
        )
    count = int((values > EXACT * values[0]).sum())
    if count < min(points - 1, 2 * frames) and count % 3:
        return (
            f"The tracks are exact and of rank {count}, not a multiple of 3: a basis shape has fewer than three "
            "dimensions. Then many rotations and shapes explain the tracks equally well, and one of them is given.",
        )
    return ()


def _numbers_of_modes(frames: int, rank: int | None) -> list[int]:
    if rank is None:
        return sorted({_most(modes, frames) for modes in MODES})
    if not 2 <= rank <= frames:
        raise SettingProblem(f"{rank} basis shapes cannot be told from {frames} frames: 2 to {frames} can.")
    return [rank - 1]


def _refined(known: Floats, weight: Floats, best: _Answer, numbers: list[int], noise: float) -> list[_Answer]:
    """Refine the best path's answer with several numbers of modes."""
    answers = []
    for modes in numbers:
        model = begin(known, weight, best.rotation, best.shapes, modes, noise)
        improve(model, known, weight, ROUNDS)
        answers.append(replace(best, model=model, cost=model.cost + PRICE * basis_cost(model)))
    return answers


def _is_rigid(tried: list[_Answer]) -> bool:
    """Tell whether no modes are worth their price beside a rigid object: noise alone fills modes, too."""
    full = [answer.cost + (PRICE_OF_DEFORMING - PRICE) * basis_cost(answer.model) for answer in tried]
    return not len(tried[0].model.modes) and full[0] <= min(full)


def _hold_lengths(model: DeformingModel, known: Floats, weight: Floats) -> None:
    """Refine with distances that are kept, too; modes that do nothing would come loose, and are left out."""
    keep_modes(model, model.mode_sizes() > IDLE)
    if not len(model.modes):
        return
    for _ in range(MOST_CHOICES):
        before = model.shapes
        model.lengths = choose_lengths(before)
        improve(model, known, weight, LENGTH_ROUNDS)
        if np.sqrt(np.mean((model.shapes - before) ** 2)) < SETTLED:
            break


def _doubt(model: DeformingModel, answers: list[_Answer], coordinates: float) -> tuple[Floats, Floats]:
    """Say how far answers differ, each turned and mirrored to fit the shapes best, as far as they are credible.

    With infinitely many coordinates all are credible alike.

    Returns:
        Mean squares of the shapes' differences (F, 3, P) and of the turns' about the camera's axes (F, 3).
    """
    shapes = model.shapes
    of_shape, of_turn = np.zeros(shapes.shape), np.zeros((len(shapes), 3))
    rows = shapes.transpose(1, 0, 2).reshape(3, -1)
    costs = np.array([answer.cost for answer in answers]) / coordinates
    shares = np.exp(-(costs - costs.min()) / CREDIBLE)
    for answer, share in zip(answers, shares / shares.sum(), strict=True):
        u, _, vt = np.linalg.svd(rows @ answer.model.shapes.transpose(1, 0, 2).reshape(3, -1).T)
        axes = u @ vt
        of_shape += share * (axes @ answer.model.shapes - shapes) ** 2
        rotation = answer.model.rotation @ axes.T
        rotation[:, 2] *= np.sign(np.linalg.det(axes))
        of_turn += share * rotations.log(rotation @ np.swapaxes(model.rotation, 1, 2)) ** 2
    return of_shape, of_turn


def _judge(known: Floats, weight: Floats, complete: Floats) -> tuple[_Answer, list[_Answer]]:
    """Make candidates; give the steadiest of those under which the tracks are nearly most probable, and all."""
    found = [rotation for _, rotation in rotation_candidates(complete)]
    found.append(_without_mirrors(complete, min(found, key=lambda r: nuclear_norm(smooth_shapes(complete, r)))))
    firsts, paths = [], {}
    for span in SPANS:
        paths[span] = [steadier(rotation, span) for rotation in found]
        paths[span].sort(key=lambda path: nuclear_norm(smooth_shapes(complete, path)))
        firsts.append(_judged(known, weight, complete, paths[span][0], span))
    enough = min(judged.cost for judged in firsts) + TOLD_APART * 2 * float(weight.sum())
    steadiest = next(judged for judged in reversed(firsts) if judged.cost <= enough)
    others = paths[steadiest.span][1:BEST_OF_SPAN]
    rivals = [_judged(known, weight, complete, path, steadiest.span) for path in others]
    return min([steadiest, *rivals], key=lambda judged: judged.cost), [*firsts, *rivals]


def _judged(known: Floats, weight: Floats, complete: Floats, path: Floats, span: float) -> _Answer:
    shapes = smooth_shapes(complete, path)
    model = begin(known, weight, path, shapes, _most(JUDGING_MODES, len(known)), JUDGING_NOISE)
    improve(model, known, weight, JUDGING_ROUNDS, JUDGING_NOISE)
    return _Answer(path, shapes, span, model, model.cost + basis_cost(model))


def _most(modes: int, frames: int) -> int:
    return max(1, min(modes, frames // FRAMES_A_MODE))


def _without_mirrors(complete: Floats, rotation: Floats, most: int = 6, tried: int = 12) -> Floats:
    """Mirror depth from some frames on where that makes the shapes simpler; the most sudden turns are tried."""
    norm = nuclear_norm(smooth_shapes(complete, rotation))
    for _ in range(most):
        sudden = np.linalg.norm(accelerations(rotation), axis=1)
        places = 1 + np.argsort(sudden)[::-1][:tried]
        others = [mirrored_after(rotation, int(frame)) for frame in places]
        norms = [nuclear_norm(smooth_shapes(complete, other)) for other in others]
        if not norms or min(norms) > 0.999 * norm:
            break
        norm, rotation = min(norms), others[int(np.argmin(norms))]
    return rotation


def _tell(
    model: DeformingModel,
    weight: Floats,
    doubt: list[tuple[Floats, Floats]],
    tracks: Floats,
    size: float,
    middle: Floats,
) -> NonRigidShapes:
    """Give the answer in the tracks' unit, in the axes of the first frame's camera."""
    turn = model.rotation[0]
    mean = model.mean + np.einsum("m,mip->ip", model.weights.mean(0), model.modes)
    points = mean.shape[1]
    left = np.einsum("fm,mip->fip", model.weights - model.weights.mean(0), model.modes).reshape(len(tracks), -1)
    u, d, vt = singular_vectors(left)
    count = int((d[: len(model.modes)] > KEPT * np.sqrt(len(tracks) * points)).sum())
    weights = u[:, :count] * d[:count] / np.sqrt(points)
    modes = (vt[:count] * np.sqrt(points)).reshape(count, 3, points)
    coefficients = np.concatenate([np.ones((len(tracks), 1)), weights * size], 1)
    basis = np.concatenate([(turn @ mean * size)[None], turn @ modes])
    shape = np.einsum("fk,kip->fip", coefficients, basis)
    rotation = model.rotation @ turn.T
    translation = model.shift * size + middle
    slow = slow_turn_covariance(model.shapes, max(np.sqrt(model.variance), JUDGING_NOISE), model.unsteadiness)
    of_shape = turn**2 @ (shape_variance(model, weight) + sum(of_shape for of_shape, _ in doubt))
    of_shape += turned_covariance(turn @ slow @ turn.T, turn @ model.shapes)
    of_turn = np.einsum("fii->fi", model.covariance[0][:, :3, :3]) + sum(of_turn for _, of_turn in doubt)
    of_turn = of_turn + np.einsum("fij,fjk,fik->fi", model.rotation, slow, model.rotation)
    fit = (rotation @ shape)[:, :2] + translation[:, :, None]
    return NonRigidShapes(
        shape=shape, shape_sd=np.sqrt(of_shape) * size, rotation=rotation, translation=translation, basis=basis,
        rotation_sd=np.sqrt(of_turn), path_doubt=np.zeros((len(tracks), 3)),
        coefficients=coefficients, noise_sd=float(np.sqrt(model.variance)) * size,
        residuals=np.linalg.norm(tracks - fit, axis=1), predicted=weight == 0, steadiness=0.0,
        rank_curve=np.empty((0, 2)), notes=(),
    )  # fmt: skip
