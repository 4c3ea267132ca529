"""Shape and motion of a deforming object from the tracks of one uncalibrated camera ([Alexander2003] eq. (9)-(12)).

Unlike the paper, which leaves the number of basis shapes and the metric upgrade open, candidates are compared by their
evidence: rotations for several numbers of shapes, each also with smoothed camera paths, are compared by the probability
of the tracks under one Gaussian model of a deforming shape, and the best candidate is refined with that model.
"""

from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.errors import MareyError, SettingProblem
from marey.geometry import rotations
from marey.nonrigid.core.completion import COMPLETION_RANK, complete_tracks, singular_vectors
from marey.nonrigid.core.deforming_model import (
    DeformingModel,
    DeformingModelSettings,
    basis_cost,
    initial_model,
    keep_modes,
    refine,
    shape_variance,
)
from marey.nonrigid.core.kept_lengths import KeptLengthSettings, choose_lengths
from marey.nonrigid.core.metric_upgrade import MetricUpgradeSettings, rotation_candidates
from marey.nonrigid.core.refinement import COMPARISON_NOISE, FEWEST_FRAMES, RefinementSettings
from marey.nonrigid.core.rotation_paths import accelerations, mirrored_after, smoothed_path
from marey.nonrigid.core.slow_turns import SlowTurnSettings, slow_turn_covariance, turned_covariance
from marey.nonrigid.core.smooth_shapes import nuclear_norm, smooth_shapes
from marey.nonrigid.core.track_checks import FEWEST_POINTS, RIGID, check_tracks
from marey.nonrigid.in_space.rank import significant_singular_values

FEWEST_IN_ALL = 7
"""Least number of points of a sequence before one camera; with fewer, too few singular values distinguish depth from
noise."""


@dataclass(frozen=True, kw_only=True)
class OneViewSettings:
    """Settings of the factorisation of one orthographic camera's tracks.

    The defaults were chosen while looking at the five sequences of `nonrigid/`, those of `lengths` also at some other
    camera paths of bench/nonrigid/camera_paths.py (docs/explanation/nonrigid.md). Where nothing else is stated, results
    were not measured against other values. Evidence is given in natural logarithms per coordinate of the tracks.
    """

    completion_rank: int = COMPLETION_RANK
    """Rank, beside the translation, of the completed tracks from which rotations are computed."""
    spans: tuple[float, ...] = (0.0, 1.0, 1e2, 1e4, 1e6, 1e8, 1e10)
    """Weights of the camera's squared accelerations with which paths are smoothed (`smoothed_path`)."""
    equal_evidence: float = 0.02
    """Among camera paths whose evidence is within this of the best, the smoothest is chosen: a slow rotation of the
    object as a whole and one of the camera look alike. On `pickup` without noise, a path with an error of 0.18 leads by
    0.001. Metric A of a leg that walks before a camera with 9 degrees per frame is 0.232 with 0.01, and 0.016 with
    0.02."""
    credible_evidence: float = 0.002
    """Candidates are averaged with weights that fall by a factor e per this much evidence. It is more than one over the
    number of coordinates because the residuals of the model are correlated over many frames and points."""
    candidates: int = 3
    """Number of rotations with the least nuclear norm of the shapes that are compared at the chosen smoothness."""
    comparison_noise: float = COMPARISON_NOISE
    """Least standard deviation of the noise when candidates are compared, as a fraction of the object's size."""
    comparison_modes: int = 12
    """Number of modes with which candidates are compared."""
    comparison_rounds: int = 10
    """Number of rounds of expectation maximisation with which candidates are compared."""
    frames_per_mode: int = 8
    """Least number of frames per mode."""
    mirrored_segments: int = 6
    """Largest number of frames from which on depth is mirrored. From the preliminary study, in which it was chosen with
    eight motion-capture sequences in view."""
    mirror_trials: int = 12
    """Number of frames, those of the largest accelerations, from which mirroring is tried."""
    mirror_gain: float = 0.999
    """Mirroring is accepted where it lowers the nuclear norm below this fraction. From the preliminary study; mirroring
    reduced the error of `yoga` there from 0.298 to 0.080 and that of `walking` from 0.334 to 0.223."""
    length_rounds: int = 8
    """Number of rounds with constant distances before these are selected again."""
    length_selections: int = 4
    """Largest number of selections of the distances."""
    length_tolerance: float = 2e-3
    """Selections end when the shapes change by less than this fraction of the object's size."""
    least_singular_value: float = 1e-9
    """Singular values below this fraction of the largest count as zero; a numerical threshold."""
    least_weight: float = 1e-5
    """Modes that move points by less than this fraction of the object's size are removed before distances are added."""
    reported_path_deviation: float = 0.5
    """A note is given where other camera paths deviate by more than this, root mean square [degrees]."""
    model: DeformingModelSettings = field(default_factory=DeformingModelSettings)
    """Settings of the Gaussian model."""
    refinement: RefinementSettings = field(default_factory=RefinementSettings)
    """Settings of the final fit."""
    upgrade: MetricUpgradeSettings = field(default_factory=MetricUpgradeSettings)
    """Settings of the search for rotations."""
    lengths: KeptLengthSettings = field(default_factory=KeptLengthSettings)
    """Settings of the constant distances."""
    slow_turns: SlowTurnSettings = field(default_factory=SlowTurnSettings)
    """Settings of the uncertainty of slow rotations."""


@dataclass(frozen=True, eq=False, kw_only=True)
class NonRigidShapes:
    """Shapes and motion before one camera: tracks = the first two rows of rotation @ shape, plus translation.

    What one orthographic camera does not determine is chosen by convention: the sign of depth (of the two mirror images
    the one whose first frame has its third row along +z by a cross product), the distance, and the object's axes, which
    are the camera's in the first frame. Lengths are in the tracks' unit (pixels); the scale in space is unknown.
    """

    shape: Floats
    """(F, 3, P) in the object's frame, including points that were not seen (`predicted`)."""
    shape_sd: Floats
    """(F, 3, P) standard deviation of the shape."""
    rotation: Floats
    """(F, 3, 3) camera from object."""
    rotation_sd: Floats
    """(F, 3) standard deviation of the rotation about the camera's axes [rad]."""
    translation: Floats
    """(F, 2) image of the object's origin."""
    basis: Floats
    """(K, 3, P) mean shape, and modes of root mean square 1 per point, the largest first."""
    coefficients: Floats
    """(F, K) weights of the basis shapes; the first is 1."""
    noise_sd: float
    """Standard deviation of a coordinate of the tracks about the model, at least a fraction of the object's size
    (`RefinementSettings.least_noise`)."""
    residuals: Floats
    """(F, P) distance of each seen point from the model; NaN where not seen."""
    predicted: Mask
    """(F, P) true where the shape includes a point that was not seen."""
    steadiness: float
    """Weight of the accelerations that was chosen for the camera's path (`OneViewSettings.spans`)."""
    rank_curve: Floats
    """(n, 2) numbers of basis shapes K that were tried, and the cost of each: minus the log-probability of the tracks
    plus a cost of the shapes, per coordinate. The least is chosen, without shapes of negligible size; K = 1, a rigid
    object, already where the others are not better at a higher cost (`RefinementSettings.rigid_cost_share`)."""
    path_ambiguity: Floats
    """(F, 3) deviation of camera paths of another smoothness that explain the tracks nearly as well, root mean square
    [rad]. The standard deviations apply to a camera as smooth as this one; this deviation is in addition to them."""
    notes: tuple[str, ...]
    """Notes for the user."""

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
        """Number of basis shapes K, including the mean."""
        return len(self.basis)

    @property
    def point_rms(self) -> Floats:
        """(P,) root mean square distance of each point from the model."""
        return np.asarray(np.sqrt(np.nanmean(self.residuals**2, 0)))


@dataclass
class _Candidate:
    """One candidate solution with its cost."""

    rotation: Floats
    """(F, 3, 3) initial path."""
    shapes: Floats
    """(F, 3, P) closed-form shapes for that path."""
    span: float
    """Weight of the accelerations with which the path was smoothed."""
    model: DeformingModel
    cost: float
    """Minus the log-probability of the tracks, plus the cost of the modes."""


@dataclass(frozen=True)
class _Tracks:
    """Tracks in units of the object's size, centred in each frame."""

    known: Floats
    """(F, 2, P), 0 where not seen."""
    weight: Floats
    """(F, P) 1 where seen, else 0."""
    complete: Floats
    """(F, 2, P) with filled gaps."""

    @property
    def coordinates(self) -> float:
        """Number of coordinates seen."""
        return 2 * float(self.weight.sum())


def factorise_tracks(
    tracks: Floats, *, rank: int | None = None, settings: OneViewSettings = OneViewSettings()
) -> NonRigidShapes:
    """Estimate shapes, rotations and basis shapes from the tracks of one orthographic camera of constant scale.

    Args:
        tracks: (F, 2, P) in any unit; NaN where a point is not seen.
        rank: Number of basis shapes K, including the mean; chosen by evidence if None.
        settings: Tuned constants of the algorithm.

    Returns:
        The shapes.

    Raises:
        SettingProblem: The rank is below 2 or above the number of frames.
        MareyError: There are too few frames or points, a frame or point is never seen, or the camera sees the object
            from one side only.
    """
    tracks = np.asarray(tracks, float)
    seen = _checked(tracks)
    numbers = _mode_counts(len(tracks), rank, settings)
    weight = seen.astype(float)
    known = np.where(seen[:, None], tracks, 0)
    middle = known.sum(2) / weight.sum(1)[:, None]
    known = np.where(seen[:, None], known - middle[:, :, None], 0)
    size = float(np.sqrt((known**2).sum() / (2 * weight.sum())))
    if size == 0:
        raise MareyError("All points coincide in every frame: there is no shape to estimate.")
    known = known / size
    complete, noise = (known, 0.0) if seen.all() else complete_tracks(known, seen, settings.completion_rank)
    notes = _check_singular_values(complete, noise, settings)
    data = _Tracks(known, weight, complete)
    best, compared = _compare_paths(data, settings)
    noise = max(noise, settings.refinement.initial_noise)
    tried = _refined(data, best, [0, *numbers] if rank is None else numbers, noise, settings)
    rigid = _is_rigid(tried, settings)
    rivals = [] if rigid else [candidate for candidate in compared if candidate.span == best.span]
    refined = tried[:1] if rigid else [candidate for candidate in tried if len(candidate.model.modes)]
    model = copy(min(refined, key=lambda candidate: candidate.cost).model)
    _hold_lengths(model, data, settings)
    groups = [group for group in (rivals, refined) if group]
    deviations = [_deviation(model, group, data.coordinates, settings) for group in groups]
    found = _result(model, data, deviations, tracks, size, middle, settings)
    curve = [(1 + len(candidate.model.modes), candidate.cost / data.coordinates) for candidate in tried]
    enough = min(candidate.cost for candidate in compared) + settings.equal_evidence * data.coordinates
    others = [candidate for candidate in compared if candidate.span != best.span and candidate.cost <= enough]
    path_ambiguity = np.zeros((len(tracks), 3))
    if others:
        path_ambiguity = np.sqrt(_deviation(model, others, np.inf, settings)[1])
    found = replace(found, steadiness=best.span, rank_curve=np.array(curve), path_ambiguity=path_ambiguity)
    return replace(found, notes=(*notes, *_result_notes(found, settings)))


def _result_notes(found: NonRigidShapes, settings: OneViewSettings) -> list[str]:
    notes = []
    deviation = float(np.degrees(np.sqrt((found.path_ambiguity**2).sum(1).mean())))
    sd = np.degrees(np.sqrt((found.rotation_sd**2).sum(1).mean()))
    if deviation > settings.reported_path_deviation and deviation > 2 * sd:
        notes.append(
            f"Camera paths that differ from this one by {deviation:.1f} degrees explain the tracks nearly as well: the "
            "tracks do not determine which part of a slow rotation belongs to the camera and which to the object. The "
            "smoothest path is given, with standard deviations that apply to a camera as smooth as that."
        )
    return [*notes, RIGID] if found.rank == 1 else notes


def _checked(tracks: Floats) -> Mask:
    if tracks.ndim != 3:
        raise MareyError(f"Tracks have shape {tracks.shape}; expected (frames, 2, points).")
    seen = check_tracks(tracks, points=FEWEST_POINTS, frames=FEWEST_FRAMES)
    if tracks.shape[2] < FEWEST_IN_ALL:
        raise MareyError(
            f"{tracks.shape[2]} points are too few for one camera: {FEWEST_IN_ALL} are needed to distinguish depth "
            "from noise."
        )
    return seen


def _check_singular_values(complete: Floats, noise: float, settings: OneViewSettings) -> tuple[str, ...]:
    """Check the singular values of the tracks for missing parallax (an error) and for a flat basis shape (a note)."""
    frames, _, points = complete.shape
    values = np.linalg.svd(complete.reshape(2 * frames, points), compute_uv=False)
    least = max(settings.least_singular_value * values[0], noise * (np.sqrt(2 * frames) + np.sqrt(points)))
    if values[2] < least or significant_singular_values(values[:-1], (2 * frames, points - 1)) < 3:
        raise MareyError(
            "The tracks move as a flat image does: the camera sees the object from one side only, "
            "so that depth cannot be determined. Film while the object rotates, or use a second camera."
        )
    count = int((values > settings.least_singular_value * values[0]).sum())
    if count < min(points - 1, 2 * frames) and count % 3:
        return (
            f"The tracks are exact and of rank {count}, not a multiple of 3: a basis shape has fewer than three "
            "dimensions. Many rotations and shapes then explain the tracks equally well; one of them is given.",
        )
    return ()


def _mode_counts(frames: int, rank: int | None, settings: OneViewSettings) -> list[int]:
    if rank is None:
        return sorted({_most_modes(modes, frames, settings) for modes in settings.refinement.mode_counts})
    if not 2 <= rank <= frames:
        raise SettingProblem(f"{frames} frames determine 2 to {frames} basis shapes, not {rank}.")
    return [rank - 1]


def _refined(
    data: _Tracks, best: _Candidate, counts: list[int], noise: float, settings: OneViewSettings
) -> list[_Candidate]:
    """Refine the best candidate with several numbers of modes."""
    candidates, refinement = [], settings.refinement
    for modes in counts:
        model = initial_model(
            data.known, data.weight, best.rotation, best.shapes, modes, noise, settings=settings.model
        )  # fmt: skip
        refine(model, data.known, data.weight, refinement.rounds, refinement.least_noise)
        candidates.append(replace(best, model=model, cost=model.cost + refinement.cost_share * basis_cost(model)))
    return candidates


def _is_rigid(tried: list[_Candidate], settings: OneViewSettings) -> bool:
    """Check whether no modes are worth their cost against a rigid object; noise alone also fills modes."""
    more = settings.refinement.rigid_cost_share - settings.refinement.cost_share
    full = [candidate.cost + more * basis_cost(candidate.model) for candidate in tried]
    return not len(tried[0].model.modes) and full[0] <= min(full)


def _hold_lengths(model: DeformingModel, data: _Tracks, settings: OneViewSettings) -> None:
    """Refine with constant distances too; modes of negligible size, which nothing would hold, are removed first."""
    keep_modes(model, model.mode_sizes() > settings.least_weight)
    if not len(model.modes):
        return
    for _ in range(settings.length_selections):
        before = model.shapes
        model.lengths = choose_lengths(before, settings.lengths)
        refine(model, data.known, data.weight, settings.length_rounds, settings.refinement.least_noise)
        if np.sqrt(np.mean((model.shapes - before) ** 2)) < settings.length_tolerance:
            break


def _deviation(
    model: DeformingModel, candidates: list[_Candidate], coordinates: float, settings: OneViewSettings
) -> tuple[Floats, Floats]:
    """Compute the deviation of candidates, each rotated and mirrored to fit the shapes best, weighted by credibility.

    Args:
        model: The estimate.
        candidates: Other solutions.
        coordinates: Number of coordinates of the tracks; if infinite, all candidates have the same weight.
        settings: Credibility.

    Returns:
        Mean squares of the shapes' differences (F, 3, P) and of the rotations' about the camera's axes (F, 3).
    """
    shapes = model.shapes
    of_shape, of_turn = np.zeros(shapes.shape), np.zeros((len(shapes), 3))
    rows = shapes.transpose(1, 0, 2).reshape(3, -1)
    costs = np.array([candidate.cost for candidate in candidates]) / coordinates
    shares = np.exp(-(costs - costs.min()) / settings.credible_evidence)
    for candidate, share in zip(candidates, shares / shares.sum(), strict=True):
        u, _, vt = np.linalg.svd(rows @ candidate.model.shapes.transpose(1, 0, 2).reshape(3, -1).T)
        axes = u @ vt
        of_shape += share * (axes @ candidate.model.shapes - shapes) ** 2
        rotation = candidate.model.rotation @ axes.T
        rotation[:, 2] *= np.sign(np.linalg.det(axes))
        of_turn += share * rotations.log(rotation @ np.swapaxes(model.rotation, 1, 2)) ** 2
    return of_shape, of_turn


def _compare_paths(data: _Tracks, settings: OneViewSettings) -> tuple[_Candidate, list[_Candidate]]:
    """Compare camera paths; return the smoothest of those with nearly the best evidence, and all candidates."""
    complete = data.complete
    found = [rotation for _, rotation in rotation_candidates(complete, settings.upgrade)]
    simplest = min(found, key=lambda rotation: nuclear_norm(smooth_shapes(complete, rotation)))
    found.append(_without_mirrors(complete, simplest, settings))
    firsts, paths = [], {}
    for span in settings.spans:
        paths[span] = [smoothed_path(rotation, span) for rotation in found]
        paths[span].sort(key=lambda path: nuclear_norm(smooth_shapes(complete, path)))
        firsts.append(_candidate(data, paths[span][0], span, settings))
    enough = min(candidate.cost for candidate in firsts) + settings.equal_evidence * 2 * float(data.weight.sum())
    smoothest = next(candidate for candidate in reversed(firsts) if candidate.cost <= enough)
    others = paths[smoothest.span][1 : settings.candidates]
    rivals = [_candidate(data, path, smoothest.span, settings) for path in others]
    return min([smoothest, *rivals], key=lambda candidate: candidate.cost), [*firsts, *rivals]


def _candidate(data: _Tracks, path: Floats, span: float, settings: OneViewSettings) -> _Candidate:
    """Fit the model to a camera path (F, 3, 3) and compute its cost."""
    shapes, noise = smooth_shapes(data.complete, path), settings.comparison_noise
    modes = _most_modes(settings.comparison_modes, len(data.known), settings)
    model = initial_model(data.known, data.weight, path, shapes, modes, noise, settings=settings.model)
    refine(model, data.known, data.weight, settings.comparison_rounds, noise)
    return _Candidate(path, shapes, span, model, model.cost + basis_cost(model))


def _most_modes(modes: int, frames: int, settings: OneViewSettings) -> int:
    return max(1, min(modes, frames // settings.frames_per_mode))


def _without_mirrors(complete: Floats, rotation: Floats, settings: OneViewSettings) -> Floats:
    """Mirror depth from some frames on where that makes the shapes simpler; the largest accelerations are tried."""
    norm = nuclear_norm(smooth_shapes(complete, rotation))
    for _ in range(settings.mirrored_segments):
        sudden = np.linalg.norm(accelerations(rotation), axis=1)
        places = 1 + np.argsort(sudden)[::-1][: settings.mirror_trials]
        others = [mirrored_after(rotation, int(frame)) for frame in places]
        norms = [nuclear_norm(smooth_shapes(complete, other)) for other in others]
        if not norms or min(norms) > settings.mirror_gain * norm:
            break
        norm, rotation = min(norms), others[int(np.argmin(norms))]
    return rotation


def _result(
    model: DeformingModel,
    data: _Tracks,
    deviations: list[tuple[Floats, Floats]],
    tracks: Floats,
    size: float,
    middle: Floats,
    settings: OneViewSettings,
) -> NonRigidShapes:
    """Convert the model to the tracks' unit and to the axes of the first frame's camera."""
    turn = model.rotation[0]
    mean = model.mean + np.einsum("m,mip->ip", model.weights.mean(0), model.modes)
    points = mean.shape[1]
    left = np.einsum("fm,mip->fip", model.weights - model.weights.mean(0), model.modes).reshape(len(tracks), -1)
    u, d, vt = singular_vectors(left)
    least = settings.refinement.least_mode_size * np.sqrt(len(tracks) * points)
    count = int((d[: len(model.modes)] > least).sum())
    weights = u[:, :count] * d[:count] / np.sqrt(points)
    modes = (vt[:count] * np.sqrt(points)).reshape(count, 3, points)
    coefficients = np.concatenate([np.ones((len(tracks), 1)), weights * size], 1)
    basis = np.concatenate([(turn @ mean * size)[None], turn @ modes])
    shape = np.einsum("fk,kip->fip", coefficients, basis)
    rotation = model.rotation @ turn.T
    translation = model.shift * size + middle
    noise = max(np.sqrt(model.variance), settings.comparison_noise)
    slow = slow_turn_covariance(model.shapes, noise, model.acceleration_variance, settings.slow_turns)
    of_shape = turn**2 @ (shape_variance(model, data.weight) + sum(of_shape for of_shape, _ in deviations))
    of_shape += turned_covariance(turn @ slow @ turn.T, turn @ model.shapes)
    of_turn = np.einsum("fii->fi", model.covariance[0][:, :3, :3]) + sum(of_turn for _, of_turn in deviations)
    of_turn = of_turn + np.einsum("fij,fjk,fik->fi", model.rotation, slow, model.rotation)
    fit = (rotation @ shape)[:, :2] + translation[:, :, None]
    return NonRigidShapes(
        shape=shape, shape_sd=np.sqrt(of_shape) * size, rotation=rotation, translation=translation, basis=basis,
        rotation_sd=np.sqrt(of_turn), path_ambiguity=np.zeros((len(tracks), 3)),
        coefficients=coefficients, noise_sd=float(np.sqrt(model.variance)) * size,
        residuals=np.linalg.norm(tracks - fit, axis=1), predicted=data.weight == 0, steadiness=0.0,
        rank_curve=np.empty((0, 2)), notes=(),
    )  # fmt: skip
