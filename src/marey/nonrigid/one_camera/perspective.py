"""Shape and motion of a deforming object from the tracks of one camera in full perspective with a known matrix.

[Alexander2003] section 2.4 names an iterative extension of the factorisation to full perspective without giving it.
Here it yields some of the initial solutions; the others come from constant distances between neighbours. All are
refined by one model in perspective (`perspective_model`); the most probable one is the result, compared with its mirror
image.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.errors import MareyError
from marey.geometry import rotations
from marey.nonrigid.core.refinement import COMPARISON_NOISE, FEWEST_FRAMES, INITIAL_NOISE, LEAST_MODE_SIZE
from marey.nonrigid.core.track_checks import RIGID, check_tracks
from marey.nonrigid.in_space.rank import significant_singular_values
from marey.nonrigid.one_camera.inextensible import neighbours
from marey.nonrigid.one_camera.perspective_joint import PerspectiveJointSettings, posterior_draws, refine_jointly
from marey.nonrigid.one_camera.perspective_model import (
    MOTION,
    PerspectiveModel,
    PerspectiveModelSettings,
    initial_model,
    refine,
)
from marey.nonrigid.one_camera.perspective_starts import (
    PerspectiveStart,
    PerspectiveStartSettings,
    affine_starts,
    inextensible_start,
    start_of,
)

FEWEST_PERSPECTIVE_POINTS = 6
"""Least number of points that a camera in perspective must see in a frame. Chosen by hand; results were not measured
against other values."""
NO_SOLUTION = "No shape was found that explains these tracks with the given camera matrix. Check the matrix."
"""Error where all initial solutions fail."""
NO_PERSPECTIVE = (
    "Perspective is too weak here: the mirror image in depth explains the tracks equally well. The sign of depth is "
    "undetermined, and the orthographic method (without a camera matrix) suits these tracks equally well."
)
"""Note where the sign of depth is undetermined."""
_COINCIDENT = 1e-12
"""Points whose spread is below this fraction of their coordinates coincide; a numerical threshold."""
_STARTED, _JUDGED, _REFINED, _IMPROVED = 0.2, 0.5, 0.65, 0.9
"""Fractions of the computing time that have passed at the end of each stage, for the progress reporter."""


@dataclass(frozen=True, kw_only=True)
class PerspectiveSettings:
    """Settings of the factorisation in full perspective.

    Where nothing else is stated, defaults were chosen by hand, and results were not measured against other values.
    """

    neighbours: int = 8
    """Number of neighbours of each point whose distances stay nearly constant."""
    extending_modes: int = 6
    """Largest number of modes in the iterative extension."""
    comparison_modes: int = 12
    """Largest number of modes with which initial solutions are compared."""
    comparison_rounds: int = 8
    """Number of rounds of expectation maximisation with which initial solutions are compared."""
    comparison_noise: float = COMPARISON_NOISE
    """Least standard deviation of the noise in that comparison, as a fraction of the object's size in the image."""
    modes: int = 20
    """Largest number of modes of the result."""
    rounds: int = 8
    """Number of rounds of expectation maximisation of the result."""
    joint_rounds: int = 6
    """Number of rounds in which motion and shapes are solved together."""
    least_stretch: float = 0.015
    """An object counts as extensible where distances between neighbours change by more than this fraction."""
    correlated_frames: float = 20.0
    """Number of frames over which the distances of an extensible object change alike."""
    draws: int = 8
    """Number of random draws for the standard deviations."""
    frames_per_mode: int = 8
    """Least number of frames per mode in the iterative extension, where distances are not constrained."""
    initial_noise: float = INITIAL_NOISE
    """Initial standard deviation of the noise, as a fraction of the object's size in the image."""
    least_noise: float = 0.002
    """Least standard deviation of the noise, as a fraction of the object's size in the image."""
    least_mode_size: float = LEAST_MODE_SIZE
    """Modes with smaller weights, as a fraction of the object's size, are not part of the result."""
    least_mode_significance: float = 2.0
    """Modes are part of the result if the root mean square of their weights is at least so many standard deviations."""
    least_mirror_gap: float = 3.0
    """Difference of log-probability [natural logarithm] from which on the sign of depth counts as determined."""
    model: PerspectiveModelSettings = field(default_factory=PerspectiveModelSettings)
    """Settings of the Gaussian model."""
    starts: PerspectiveStartSettings = field(default_factory=PerspectiveStartSettings)
    """Settings of the initial solutions."""
    joint: PerspectiveJointSettings = field(default_factory=PerspectiveJointSettings)
    """Settings of the joint solution for motion and shapes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PerspectiveShapes:
    """Shapes and motion before one camera: tracks = projection by the matrix of rotation @ shape + translation.

    What the tracks do not determine is chosen by convention: the scale (the mean depth of the object's origin is the
    focal length, so that a length is in pixels as seen at that depth) and the object's axes, which are the camera's in
    the first frame. A size that changes over time looks like a distance that changes; the size is assumed to change
    least. Rotation and deformation are separated as in `factorise_points`: the motion from which the points depart
    least.
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
    """(F, 3) object's origin in camera axes, in the unit of the shape."""
    translation_sd: Floats
    """(F, 3) standard deviation of the translation."""
    basis: Floats
    """(K, 3, P) mean shape, and modes of root mean square 1 per point, the largest first."""
    coefficients: Floats
    """(F, K) weights of the basis shapes; the first is 1."""
    noise_sd: float
    """Standard deviation of a coordinate of the tracks about the model [px]."""
    residuals: Floats
    """(F, P) distance of each seen point from the model [px]; NaN where not seen."""
    predicted: Mask
    """(F, P) true where the shape includes a point that was not seen."""
    stretch: float
    """Median relative standard deviation of the distances between neighbours; 0 if rigid."""
    mirror_gap: float
    """Log-probability lost by the mirror image in depth [natural logarithm]; infinite where that explains nothing."""
    notes: tuple[str, ...]
    """Notes for the user."""

    def __post_init__(self) -> None:
        freeze_fields(self, "shape", "shape_sd", "rotation", "rotation_sd", "translation", "translation_sd")
        freeze_fields(self, "basis", "coefficients", "residuals")
        freeze_fields(self, "predicted", dtype=bool)

    @property
    def rank(self) -> int:
        """Number of basis shapes K, including the mean."""
        return len(self.basis)

    @property
    def points(self) -> Floats:
        """(F, 3, P) in camera axes."""
        return np.asarray(self.rotation @ self.shape + self.translation[:, :, None])

    @property
    def point_rms(self) -> Floats:
        """(P,) root mean square distance of each point from the model [px]."""
        return np.asarray(np.sqrt(np.nanmean(self.residuals**2, 0)))


def factorise_perspective(
    tracks: Floats,
    matrix: Floats,
    *,
    progress: Callable[[float], None] = lambda share: None,
    settings: PerspectiveSettings = PerspectiveSettings(),
) -> PerspectiveShapes:
    """Estimate shapes, poses and basis shapes from the tracks of one camera whose matrix is known.

    Args:
        tracks: (F, 2, P) in pixels, without lens distortion; NaN where a point is not seen.
        matrix: (3, 3) camera matrix: focal lengths, skew and principal point in pixels.
        progress: Progress reporter, called with the completed fraction from 0 to 1.
        settings: Tuned constants of the algorithm.

    Returns:
        The shapes; their scale is unknown.

    Raises:
        MareyError: The matrix is not a camera matrix, there are too few frames or points, a frame or point is never
            seen, or the tracks move as a flat image does.
    """
    tracks, matrix = np.asarray(tracks, float), _checked_matrix(matrix)
    seen = _checked(tracks)
    rays = np.linalg.solve(matrix, np.concatenate([np.where(seen[:, None], tracks, 0), np.ones_like(tracks[:, :1])], 1))
    known = rays[:, :2]
    size = _image_size(known, seen)
    _refuse_flat_pictures(known, seen)
    pairs = neighbours(known, seen, settings.neighbours, settings.starts.depths)
    found = _best(known, seen, pairs, size, progress, settings)
    notes = () if found.gap > settings.least_mirror_gap else (NO_PERSPECTIVE,)
    return _result(found, tracks, matrix, seen, notes, settings)


def _checked_matrix(matrix: Floats) -> Floats:
    matrix = np.asarray(matrix, float)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise MareyError(f"The camera matrix has shape {matrix.shape}; expected three rows of three finite numbers.")
    below = np.abs([matrix[1, 0], matrix[2, 0], matrix[2, 1]]).max()
    if below > 1e-9 or matrix[2, 2] <= 0 or min(matrix[0, 0], matrix[1, 1]) <= 0:
        raise MareyError(
            "This is not a camera matrix: expected [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] with focal lengths fx and "
            "fy above 0, in pixels."
        )
    return np.asarray(matrix / matrix[2, 2])


def _checked(tracks: Floats) -> Mask:
    if tracks.ndim != 3:
        raise MareyError(f"Tracks have shape {tracks.shape}; expected (frames, 2, points).")
    return check_tracks(tracks, points=FEWEST_PERSPECTIVE_POINTS, frames=FEWEST_FRAMES)


def _image_size(known: Floats, seen: Mask) -> float:
    middle = (known * seen[:, None]).sum(2) / seen.sum(1)[:, None]
    left = np.where(seen[:, None], known - middle[:, :, None], 0)
    size = float(np.sqrt((left**2).sum() / (2 * seen.sum())))
    if size <= _COINCIDENT * float(np.abs(known).max()):
        raise MareyError("All points coincide in every frame: there is no shape to estimate.")
    return size


def _refuse_flat_pictures(known: Floats, seen: Mask) -> None:
    """Reject tracks that only shift, rotate and scale in the image, which any depth explains."""
    weight = seen.astype(float)
    place = np.where(seen, known[:, 0] + 1j * known[:, 1], 0)
    place = np.where(seen, place - (place.sum(1) / weight.sum(1))[:, None], 0)
    picture = place.sum(0) / weight.sum(0)
    for _ in range(10):
        motion = (place * picture.conj()).sum(1) / (weight * abs(picture) ** 2).sum(1)
        picture = (place * motion.conj()[:, None]).sum(0) / (weight * abs(motion[:, None]) ** 2).sum(0)
    left = np.where(seen, place - motion[:, None] * picture, 0)
    values = np.linalg.svd(np.concatenate([left.real, left.imag]), compute_uv=False)
    whole = float(np.sqrt((abs(place) ** 2).sum()))
    if values[0] < 1e-9 * whole or significant_singular_values(values[:-2], (2 * len(known), known.shape[2] - 2)) < 1:
        raise MareyError(
            "The tracks move as a flat image does: they only shift, rotate and scale, "
            "so that any depth explains them. Film while the object rotates."
        )


@dataclass(frozen=True)
class _Solution:
    model: PerspectiveModel
    rivals: list[PerspectiveStart]
    """Solutions with fewer modes and more noise, with unconstrained distances, and with the firmest distances."""
    gap: float
    """Log-probability lost by the mirror image."""
    drawn: list[PerspectiveStart] = field(default_factory=list)
    """Random draws from the joint posterior of motion and shapes."""


@dataclass(frozen=True)
class _ImageTracks:
    """Tracks in normalised image coordinates."""

    known: Floats
    """(F, 2, P), with arbitrary values where not seen."""
    weight: Floats
    """(F, P) 1 where seen, else 0."""
    size: float
    """Root mean square coordinate about the centre of each frame."""


def _best(
    known: Floats,
    seen: Mask,
    pairs: Integers,
    size: float,
    progress: Callable[[float], None],
    settings: PerspectiveSettings,
) -> _Solution:
    """Compare all initial solutions and the mirror image of the best, and refine the most probable one."""
    data = _ImageTracks(known, seen.astype(float), size)
    few = max(1, min(settings.extending_modes, len(known) // settings.frames_per_mode))
    starts = [
        inextensible_start(known, seen, pairs, settings.starts), *affine_starts(known, seen, few, settings.starts)
    ]  # fmt: skip
    compared = []
    for number, start in enumerate(starts):
        progress(_STARTED + (_JUDGED - _STARTED) * number / len(starts))
        compared.append((_compared(start, data, pairs, settings), start))
    model, start = min(compared, key=lambda pair: pair[0].cost if pair[0] else np.inf)
    if model is None:
        raise MareyError(NO_SOLUTION)
    mirrored = start_of(model).mirrored()
    other = _compared(mirrored, data, pairs, settings)
    progress(_JUDGED)
    gap = np.inf if other is None else other.cost - model.cost
    if other is not None and gap < 0:
        model, start, gap = other, mirrored, -gap
    modes, noise = min(settings.modes, len(known) - 1), settings.least_noise
    best = _refined(start, data, pairs, modes, settings.rounds, noise, settings)
    if best is None:
        raise MareyError(NO_SOLUTION)
    rigid = _rigid_if_as_good(best, data, settings)
    if rigid is not best:
        return _Solution(rigid, [], gap)
    free = _refined(start, data, pairs[:0], len(model.modes), 2 * settings.rounds, noise, settings)
    progress(_REFINED)
    rivals = [start_of(model), *_refine_with_rivals(best, free, data, settings)]
    progress(_IMPROVED)
    rng = np.random.default_rng(0)
    return _Solution(
        best, rivals, gap, list(posterior_draws(best, known, data.weight, settings.draws, rng, settings.joint))
    )  # fmt: skip


def _refine_with_rivals(
    best: PerspectiveModel, free: PerspectiveModel | None, data: _ImageTracks, settings: PerspectiveSettings
) -> Iterator[PerspectiveStart]:
    """Refine the best model; yield rivals without distances and, for extensible objects, with the firmest ones."""
    noise, rounds = settings.least_noise * data.size, settings.joint_rounds
    refine_jointly(best, data.known, data.weight, rounds, noise, settings.joint)
    if best.stretch > settings.least_stretch:
        yield start_of(best)
        best.correlated_frames = settings.correlated_frames
        for each in (best, free):
            if each is not None:
                refine_jointly(each, data.known, data.weight, 2 * rounds, noise, settings.joint)
    if free is not None:
        yield start_of(free)


def _rigid_if_as_good(model: PerspectiveModel, data: _ImageTracks, settings: PerspectiveSettings) -> PerspectiveModel:
    """Return a rigid model where the modes do not explain more than their number of parameters ([Akaike1974])."""
    shapes = np.broadcast_to(model.mean, model.shapes.shape)
    noise = settings.initial_noise * data.size
    rigid = initial_model(model.rotation, model.shift, shapes, 0, noise, model.pairs[:0], settings.model)
    refine(rigid, data.known, data.weight, settings.rounds, 0.0)
    coordinates = 2 * float(data.weight.sum())
    of_weights = model.covariance[0][:, MOTION:, MOTION:]
    modes = len(_ordered_modes(model.weights, model.modes, of_weights, 1.0, settings)[1])
    cost = 2 * modes * (3 * data.known.shape[2] + len(data.known))
    return rigid if coordinates * np.log(rigid.variance / model.variance) < cost else model


def _compared(
    start: PerspectiveStart, data: _ImageTracks, pairs: Integers, settings: PerspectiveSettings
) -> PerspectiveModel | None:
    """Fit the model to an initial solution for the comparison."""
    modes = min(settings.comparison_modes, len(data.known) - 1)
    return _refined(start, data, pairs, modes, settings.comparison_rounds, settings.comparison_noise, settings)


def _refined(
    start: PerspectiveStart,
    data: _ImageTracks,
    pairs: Integers,
    modes: int,
    rounds: int,
    noise: float,
    settings: PerspectiveSettings,
) -> PerspectiveModel | None:
    """Fit the model to an initial solution; None where this fails."""
    if not start.usable():
        return None
    try:
        initial_noise = settings.initial_noise * data.size
        model = initial_model(
            start.rotation, start.shift, start.shapes, modes, initial_noise, pairs, settings.model
        )  # fmt: skip
        refine(model, data.known, data.weight, rounds, noise * data.size)
    except np.linalg.LinAlgError:
        return None
    return model if start_of(model).usable() and np.isfinite(model.cost) else None


def _squared_differences(model: PerspectiveModel, rivals: list[PerspectiveStart]) -> tuple[Floats, Floats, Floats]:
    """Sum the squared differences of rivals from the estimate, each scaled and rotated to fit its shapes best.

    Returns:
        Sums for the shapes (F, 3, P), for the rotations about the camera's axes (F, 3), and for the shifts (F, 3).
    """
    shapes = model.shapes
    rows = shapes.transpose(1, 0, 2).reshape(3, -1)
    of_shape, of_turn, of_shift = np.zeros(shapes.shape), np.zeros((len(shapes), 3)), np.zeros((len(shapes), 3))
    for rival in rivals:
        theirs = rival.shapes.transpose(1, 0, 2).reshape(3, -1)
        axes = rotations.nearest(rows @ theirs.T)
        scale = float((rows * (axes @ theirs)).sum() / (theirs**2).sum())
        of_shape += (scale * axes @ rival.shapes - shapes) ** 2
        of_turn += rotations.log(rival.rotation @ axes.T @ np.swapaxes(model.rotation, 1, 2)) ** 2
        of_shift += (rival.shift * model.shift[:, 2].mean() / rival.shift[:, 2].mean() - model.shift) ** 2
    return of_shape, of_turn, of_shift


def _result(
    found: _Solution,
    tracks: Floats,
    matrix: Floats,
    seen: Mask,
    notes: tuple[str, ...],
    settings: PerspectiveSettings,
) -> PerspectiveShapes:
    """Convert the solution to pixels at the mean depth and to the axes of the first frame's camera."""
    model, gap, extra = found.model, found.gap, _squared_differences(found.model, found.rivals)
    for whole, part in zip(extra, _squared_differences(model, found.drawn), strict=True):
        whole += part / settings.draws
    focal = float(np.sqrt(matrix[0, 0] * matrix[1, 1]))
    size = focal / float(model.shift[:, 2].mean())
    turn = model.rotation[0]
    middle = model.weights.mean(0)
    mean = turn @ (model.mean + np.einsum("m,mip->ip", middle, model.modes)) * size
    covariance = model.covariance[0]
    of_weights = covariance[:, MOTION:, MOTION:]
    weights, modes = _ordered_modes(model.weights - middle, turn @ model.modes, of_weights, size, settings)
    basis = np.concatenate([mean[None], modes])
    coefficients = np.concatenate([np.ones((len(tracks), 1)), weights], 1)
    by_weight = turn @ model.modes * size
    variance = np.einsum("mip,fmn,nip->fip", by_weight, covariance[:, MOTION:, MOTION:], by_weight, optimize=True)
    variance = variance + turn**2 @ extra[0] * size**2
    rotation, translation = model.rotation @ turn.T, model.shift * size
    shape = np.einsum("fk,kip->fip", coefficients, basis)
    image = matrix @ (rotation @ shape + translation[:, :, None])
    own = np.einsum("fii->fi", covariance)
    return PerspectiveShapes(
        shape=shape, shape_sd=np.sqrt(variance), rotation=rotation, rotation_sd=np.sqrt(own[:, :3] + extra[1]),
        translation=translation, translation_sd=np.sqrt(own[:, 3:MOTION] + extra[2]) * size, basis=basis,
        coefficients=coefficients, noise_sd=float(np.sqrt(model.variance)) * focal,
        residuals=np.linalg.norm(tracks - image[:, :2] / image[:, 2:], axis=1), predicted=~seen,
        stretch=model.stretch, mirror_gap=gap, notes=(*notes, RIGID) if len(basis) == 1 else notes,
    )  # fmt: skip


def _ordered_modes(
    weights: Floats, modes: Floats, covariance: Floats, size: float, settings: PerspectiveSettings
) -> tuple[Floats, Floats]:
    """Compute uncorrelated weights (F, K) in the shape's unit and their modes of root mean square 1 per point.

    Modes of negligible size are excluded, and those about which the tracks contain no more information than the prior
    (such as a size that grows while the object moves away).
    """
    frames, points = len(weights), modes.shape[2]
    flat = modes.reshape(len(modes), 3 * points)
    u, d, vt = np.linalg.svd(weights @ flat, full_matrices=False)
    ordered, basis = (u * d)[:, : len(modes)] / np.sqrt(points), vt[: len(modes)] * np.sqrt(points)
    by_weight = basis @ flat.T / points
    variance = np.einsum("km,fmn,kn->k", by_weight, covariance, by_weight, optimize=True) / frames
    squares = (ordered**2).mean(0)
    kept = squares > settings.least_mode_size**2
    kept &= squares > settings.least_mode_significance**2 * variance
    return ordered[:, kept] * size, basis[kept].reshape(-1, 3, points)
