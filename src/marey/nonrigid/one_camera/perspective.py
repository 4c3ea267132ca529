"""Shape and motion of a deforming object from the tracks of one camera in full perspective, its matrix known.

[Alexander2003] section 2.4 names an iterative extension of the factorisation to full perspective and leaves it out.
Here it gives some of the starts; others come from distances between neighbours that stay. All are refined by one
model in perspective (`perspective_model`), and the most probable is told, with its mirror image beside it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.errors import MareyError
from marey.geometry import rotations
from marey.nonrigid.core.track_checks import RIGID, checked
from marey.nonrigid.in_space.rank import significant_singular_values
from marey.nonrigid.one_camera.inextensible import neighbours
from marey.nonrigid.one_camera.perspective_joint import draws, improve_jointly
from marey.nonrigid.one_camera.perspective_model import MOTION, PerspectiveModel, begin, improve
from marey.nonrigid.one_camera.perspective_starts import Start, affine_starts, inextensible_start, start_of

FEWEST_FRAMES = 6
FEWEST_POINTS = 6
NEIGHBOURS = 8
EXTENDING_MODES = 6
JUDGING_MODES = 12
JUDGING_ROUNDS = 8
JUDGING_NOISE = 0.01
"""Noise that is believed at least when starts are compared, as a share of the object's size in the image: what few
modes leave is not noise, and would decide otherwise."""
MODES = 20
ROUNDS, JOINT_ROUNDS = 8, 6
STRETCHING = 0.015
"""Distances that change by more than this share, where they count the most, do change."""
LIKE_FRAMES = 20.0
"""Frames over which they then change alike."""
DRAWS = 8
STARTED, JUDGED, REFINED, IMPROVED = 0.2, 0.5, 0.65, 0.9
"""Shares of the whole time that are over once the starts are there, and so on."""
FRAMES_A_MODE = 8
"""Frames that a displacement of an object needs whose neighbours do not keep their distance."""
FIRST_NOISE = 0.005
"""As a share of the object's size in the image."""
LEAST_NOISE = 0.002
"""As a share of the object's size in the image: less is not believed."""
KEPT = 1e-3
"""A mode whose weights are below this share of the object's size is not told."""
EXACT = 1e-12
KNOWN = 2.0
"""A mode is told if its weights are, in root mean square, so many times their standard deviation."""
TOLD = 3.0
"""Difference in the logarithm of probability from which on one of two mirror images is told."""
NO_ANSWER = "No shape was found that explains these tracks by the given camera matrix."
NO_PERSPECTIVE = (
    "Perspective tells nothing here: the mirror image in depth explains the tracks as well. The sign of depth is a "
    "guess, and the orthographic method (without --matrix) suits these tracks as well."
)


@dataclass(frozen=True, eq=False, kw_only=True)
class PerspectiveShapes:
    """Shapes and motion before one camera: tracks = projection by the matrix of rotation @ shape + translation.

    What the tracks cannot tell is chosen: the scale (the mean depth of the object's origin is the focal length, so that
    a length is in pixels as seen at that depth) and the object's axes, which are the camera's in the first frame.
    A size that changes over time looks like a distance that changes; the size is believed to change the least.
    The turn and the deformation are parted as in `factorise_points`: the motion from which the points depart least.
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
    """(F, 3) of the object's origin before the camera, in the unit of the shape."""
    translation_sd: Floats
    """(F, 3)."""
    basis: Floats
    """(K, 3, P) the mean shape, and displacements of root mean square 1 a point, the largest first."""
    coefficients: Floats
    """(F, K) weights; the first is 1."""
    noise_sd: float
    """Standard deviation of a coordinate of the tracks about the model [px]."""
    residuals: Floats
    """(F, P) distance of a seen point from the model [px]; NaN where not seen."""
    predicted: Mask
    """(F, P) true where the shape of a point is given that was not seen."""
    stretch: float
    """How much distances between neighbours change, median of their deviations over them; 0 if rigid."""
    mirror_gap: float
    """By how much the mirror image in depth is less probable (natural logarithm); infinite where it has no answer."""
    notes: tuple[str, ...]
    """What a user should know of this answer."""

    def __post_init__(self) -> None:
        freeze_fields(self, "shape", "shape_sd", "rotation", "rotation_sd", "translation", "translation_sd")
        freeze_fields(self, "basis", "coefficients", "residuals")
        freeze_fields(self, "predicted", dtype=bool)

    @property
    def rank(self) -> int:
        """K, the number of basis shapes with the mean."""
        return len(self.basis)

    @property
    def points(self) -> Floats:
        """(F, 3, P) before the camera."""
        return np.asarray(self.rotation @ self.shape + self.translation[:, :, None])

    @property
    def point_rms(self) -> Floats:
        """(P,) root mean square distance of each point from the model [px]."""
        return np.asarray(np.sqrt(np.nanmean(self.residuals**2, 0)))


def factorise_perspective(
    tracks: Floats, matrix: Floats, *, told: Callable[[float], None] = lambda share: None
) -> PerspectiveShapes:
    """Find shapes, poses and basis shapes from the tracks of one camera whose matrix is known.

    Args:
        tracks: (F, 2, P) in pixels, without lens distortion; NaN where a point is not seen.
        matrix: (3, 3) of the camera: focal lengths, skew and principal point in pixels.
        told: Is called with the share that is done, from 0 to 1.

    Returns:
        The shapes; their scale is not known.

    Raises:
        MareyError: The matrix is none of a camera, there are too few frames or points, a frame or point is never
            seen, or the tracks move as a flat picture does.
    """
    tracks, matrix = np.asarray(tracks, float), _checked_matrix(matrix)
    seen = _checked(tracks)
    rays = np.linalg.solve(matrix, np.concatenate([np.where(seen[:, None], tracks, 0), np.ones_like(tracks[:, :1])], 1))
    known = rays[:, :2]
    size = _image_size(known, seen)
    _refuse_flat_pictures(known, seen)
    pairs = neighbours(known, seen, NEIGHBOURS)
    found = _best(known, seen, pairs, size, told)
    notes = () if found.gap > TOLD else (NO_PERSPECTIVE,)
    return _tell(found, tracks, matrix, seen, notes)


def _checked_matrix(matrix: Floats) -> Floats:
    matrix = np.asarray(matrix, float)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise MareyError("A camera matrix has three rows of three numbers.")
    below = np.abs([matrix[1, 0], matrix[2, 0], matrix[2, 1]]).max()
    if below > 1e-9 or matrix[2, 2] <= 0 or min(matrix[0, 0], matrix[1, 1]) <= 0:
        raise MareyError(
            "This is no camera matrix: it should read [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] with focal lengths "
            "fx and fy above 0, in pixels."
        )
    return matrix / matrix[2, 2]


def _checked(tracks: Floats) -> Mask:
    if tracks.ndim != 3:
        raise MareyError(f"Tracks have the shape {tracks.shape} and should have (frames, 2, points).")
    return checked(tracks, points=FEWEST_POINTS, frames=FEWEST_FRAMES)


def _image_size(known: Floats, seen: Mask) -> float:
    middle = (known * seen[:, None]).sum(2) / seen.sum(1)[:, None]
    left = np.where(seen[:, None], known - middle[:, :, None], 0)
    size = float(np.sqrt((left**2).sum() / (2 * seen.sum())))
    if size <= EXACT * float(np.abs(known).max()):
        raise MareyError("All points lie in one place in every frame: there is nothing to see.")
    return size


def _refuse_flat_pictures(known: Floats, seen: Mask) -> None:
    """Refuse tracks that only shift, turn and scale in the image: every depth would do."""
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
            "The tracks move as a flat picture does: they only shift, turn and scale, "
            "so that every depth explains them."
        )


@dataclass(frozen=True)
class _Found:
    model: PerspectiveModel
    rivals: list[Start]
    """With fewer modes and more noise; with distances that may change as they like, and that count the most."""
    gap: float
    """By how much the mirror image is worse."""
    drawn: list[Start] = field(default_factory=list)
    """From what is not known of motion and shapes together."""


def _best(known: Floats, seen: Mask, pairs: Integers, size: float, told: Callable[[float], None]) -> _Found:
    """Judge all starts, and the mirror image of the best; refine the winner."""
    weight, few = seen.astype(float), max(1, min(EXTENDING_MODES, len(known) // FRAMES_A_MODE))
    starts = [inextensible_start(known, seen, pairs), *affine_starts(known, seen, few)]
    judged = []
    for number, start in enumerate(starts):
        told(STARTED + (JUDGED - STARTED) * number / len(starts))
        judged.append((_judged(start, known, weight, pairs, size), start))
    model, start = min(judged, key=lambda pair: pair[0].cost if pair[0] else np.inf)
    if model is None:
        raise MareyError(NO_ANSWER)
    mirrored = start_of(model).mirrored()
    other = _judged(mirrored, known, weight, pairs, size)
    told(JUDGED)
    gap = np.inf if other is None else other.cost - model.cost
    if other is not None and gap < 0:
        model, start, gap = other, mirrored, -gap
    best = _refined(start, known, weight, pairs, size, min(MODES, len(known) - 1), ROUNDS, LEAST_NOISE)
    if best is None:
        raise MareyError(NO_ANSWER)
    rigid = _rigid_if_as_good(best, known, weight, size)
    if rigid is not best:
        return _Found(rigid, [], gap)
    free = _refined(start, known, weight, pairs[:0], size, len(model.modes), 2 * ROUNDS, LEAST_NOISE)
    told(REFINED)
    rivals = [start_of(model), *_improved(best, free, known, weight, size)]
    told(IMPROVED)
    return _Found(best, rivals, gap, list(draws(best, known, weight, DRAWS, np.random.default_rng(0))))


def _improved(
    best: PerspectiveModel, free: PerspectiveModel | None, known: Floats, weight: Floats, size: float
) -> Iterator[Start]:
    """Improve the answer, and give the rivals whose distances count for nothing, and for all if they change."""
    improve_jointly(best, known, weight, JOINT_ROUNDS, LEAST_NOISE * size)
    if best.change > STRETCHING:
        yield start_of(best)
        best.alike = LIKE_FRAMES
        for each in (best, free):
            if each is not None:
                improve_jointly(each, known, weight, 2 * JOINT_ROUNDS, LEAST_NOISE * size)
    if free is not None:
        yield start_of(free)


def _rigid_if_as_good(model: PerspectiveModel, known: Floats, weight: Floats, size: float) -> PerspectiveModel:
    """Give the rigid answer where what the told modes explain is not worth their numbers ([Akaike1974])."""
    shapes = np.broadcast_to(model.mean, model.shapes.shape)
    rigid = begin(model.rotation, model.shift, shapes, 0, FIRST_NOISE * size, model.pairs[:0])
    improve(rigid, known, weight, ROUNDS, 0.0)
    numbers = 2 * float(weight.sum())
    told = len(_ordered(model.weights, model.modes, model.covariance[0][:, MOTION:, MOTION:], 1.0)[1])
    price = 2 * told * (3 * known.shape[2] + len(known))
    return rigid if numbers * np.log(rigid.variance / model.variance) < price else model


def _judged(start: Start, known: Floats, weight: Floats, pairs: Integers, size: float) -> PerspectiveModel | None:
    modes = min(JUDGING_MODES, len(known) - 1)
    return _refined(start, known, weight, pairs, size, modes, JUDGING_ROUNDS, JUDGING_NOISE)


def _refined(
    start: Start, known: Floats, weight: Floats, pairs: Integers, size: float, modes: int, rounds: int, noise: float
) -> PerspectiveModel | None:
    if not start.usable():
        return None
    try:
        model = begin(start.rotation, start.shift, start.shapes, modes, FIRST_NOISE * size, pairs)
        improve(model, known, weight, rounds, noise * size)
    except np.linalg.LinAlgError:
        return None
    return model if start_of(model).usable() and np.isfinite(model.cost) else None


def _disagreement(model: PerspectiveModel, rivals: list[Start]) -> tuple[Floats, Floats, Floats]:
    """Sum the squares of the rivals' differences from the answer, each scaled and turned to fit its shapes best.

    Returns:
        Of the shapes (F, 3, P), of the turns about the camera's axes (F, 3), and of the shifts (F, 3).
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


def _tell(found: _Found, tracks: Floats, matrix: Floats, seen: Mask, notes: tuple[str, ...]) -> PerspectiveShapes:
    """Give the answer in pixels at the mean depth, in the axes of the first frame's camera."""
    model, gap, doubt = found.model, found.gap, _disagreement(found.model, found.rivals)
    for whole, part in zip(doubt, _disagreement(model, found.drawn), strict=True):
        whole += part / DRAWS
    focal = float(np.sqrt(matrix[0, 0] * matrix[1, 1]))
    size = focal / float(model.shift[:, 2].mean())
    turn = model.rotation[0]
    middle = model.weights.mean(0)
    mean = turn @ (model.mean + np.einsum("m,mip->ip", middle, model.modes)) * size
    covariance = model.covariance[0]
    weights, modes = _ordered(model.weights - middle, turn @ model.modes, covariance[:, MOTION:, MOTION:], size)
    basis = np.concatenate([mean[None], modes])
    coefficients = np.concatenate([np.ones((len(tracks), 1)), weights], 1)
    by_weight = turn @ model.modes * size
    variance = np.einsum("mip,fmn,nip->fip", by_weight, covariance[:, MOTION:, MOTION:], by_weight, optimize=True)
    variance = variance + turn**2 @ doubt[0] * size**2
    rotation, translation = model.rotation @ turn.T, model.shift * size
    shape = np.einsum("fk,kip->fip", coefficients, basis)
    image = matrix @ (rotation @ shape + translation[:, :, None])
    own = np.einsum("fii->fi", covariance)
    return PerspectiveShapes(
        shape=shape, shape_sd=np.sqrt(variance), rotation=rotation, rotation_sd=np.sqrt(own[:, :3] + doubt[1]),
        translation=translation, translation_sd=np.sqrt(own[:, 3:MOTION] + doubt[2]) * size, basis=basis,
        coefficients=coefficients, noise_sd=float(np.sqrt(model.variance)) * focal,
        residuals=np.linalg.norm(tracks - image[:, :2] / image[:, 2:], axis=1), predicted=~seen,
        stretch=model.change, mirror_gap=gap, notes=(*notes, RIGID) if len(basis) == 1 else notes,
    )  # fmt: skip


def _ordered(weights: Floats, modes: Floats, covariance: Floats, size: float) -> tuple[Floats, Floats]:
    """Give uncorrelated weights (F, K) in the shape's unit and their displacements of root mean square 1 a point.

    Left out are displacements that are slight, and those of which no more is known than was believed beforehand (such
    as a size that swells while the object moves away).
    """
    frames, points = len(weights), modes.shape[2]
    flat = modes.reshape(len(modes), 3 * points)
    u, d, vt = np.linalg.svd(weights @ flat, full_matrices=False)
    ordered, basis = (u * d)[:, : len(modes)] / np.sqrt(points), vt[: len(modes)] * np.sqrt(points)
    by_weight = basis @ flat.T / points
    doubt = np.einsum("km,fmn,kn->k", by_weight, covariance, by_weight, optimize=True) / frames
    squares = (ordered**2).mean(0)
    told = (squares > KEPT**2) & (squares > KNOWN**2 * doubt)
    return ordered[:, told] * size, basis[told].reshape(-1, 3, points)
