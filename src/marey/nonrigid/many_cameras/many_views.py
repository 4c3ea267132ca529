"""Shape and motion of a deforming object before several uncalibrated cameras that stand fixed.

The model is that of [Alexander2003] eq. (13) and (14): the cameras share the deformation's coefficients and one
rotation a frame. Unlike the paper, which factors the stacked tracks and enforces the fixed relative rotations
afterwards, they are there from the start: what two cameras share gives all of their relation but one angle, and that
angle is searched for, judged like the answers of one camera by how probable it makes the tracks under a Gaussian model
of a deforming shape (`deforming_model`).
"""

from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.errors import MareyError
from marey.geometry import rotations
from marey.nonrigid.core.alignment import mean_shape
from marey.nonrigid.core.deforming_model import (
    DeformingModel,
    basis_cost,
    begin,
    improve,
    residuals_and_jacobians,
    shape_variance,
    solve_shapes,
)
from marey.nonrigid.core.track_checks import RIGID, checked
from marey.nonrigid.many_cameras.view_angle import Judged, Views, best_angle, most_modes, path_of, stacked, views_of
from marey.nonrigid.many_cameras.view_checks import checked_views
from marey.nonrigid.many_cameras.view_geometry import FEWEST_FRAMES, FEWEST_POINTS, rows_of
from marey.nonrigid.one_camera.one_view import PRICE_OF_DEFORMING

MODES = (3, 6, 12, 20, 36)
PRICE = 0.3
ROUNDS = 12
FIRST_NOISE = 0.005
SHARE_IN_DOUBT = 0.7
"""Where a turn at a constant rate is believed: share of the way to the motion of least departure, as a standard
deviation."""
UNEVEN = 1.2
"""Noise of one camera over another's from which they are weighed differently."""
UNSURE = 10.0
"""Standard deviation of a camera's turn [degrees] from which it is called in doubt."""
KEPT = 1e-3
"""A mode whose weights are below this share of the object's size is not told."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ManyViewShapes:
    """Shapes and motion before several cameras.

    The tracks of camera c in frame f are the first two rows of
    scale[c] * camera_from_first[c] @ rotation[f] @ shape[f], plus translation[c, f]. What orthographic cameras cannot
    tell, however many, is chosen: one of the two mirror images (depth and relative rotations mirrored together), the
    object's axes, which are the first camera's in the first frame, and the unit, that of the first camera's tracks.
    """

    shape: Floats
    """(F, 3, P) in the object's frame, also of points that were not seen (`predicted`)."""
    shape_sd: Floats
    """(F, 3, P)."""
    rotation: Floats
    """(F, 3, 3) first camera from object."""
    rotation_sd: Floats
    """(F, 3) of the turn about the first camera's axes [rad]."""
    camera_from_first: Floats
    """(C, 3, 3) each camera from the first."""
    camera_sd: Floats
    """(C, 3) of that turn about the camera's own axes [rad]; 0 for the first."""
    scale: Floats
    """(C,) of a camera over the first."""
    translation: Floats
    """(C, F, 2); NaN where a camera sees nothing of a frame."""
    basis: Floats
    """(K, 3, P) the mean shape, and displacements of root mean square 1 a point, the largest first."""
    coefficients: Floats
    """(F, K) weights; the first is 1."""
    noise_sd: Floats
    """(C,) standard deviation of a coordinate of a camera's tracks about the model."""
    residuals: Floats
    """(C, F, P) distance of a seen point from the model; NaN where not seen."""
    predicted: Mask
    """(F, P) true where the shape of a point is given that no camera saw."""
    notes: tuple[str, ...]
    """What a user should know of this answer."""

    def __post_init__(self) -> None:
        freeze_fields(
            self,
            "shape",
            "shape_sd",
            "rotation",
            "rotation_sd",
            "camera_from_first",
            "camera_sd",
            "scale",
            "translation",
            "basis",
            "coefficients",
            "noise_sd",
            "residuals",
        )
        freeze_fields(self, "predicted", dtype=bool)

    @property
    def rank(self) -> int:
        """K, the number of basis shapes with the mean."""
        return len(self.basis)

    @property
    def point_rms(self) -> Floats:
        """(P,) root mean square distance of each point from the model."""
        return np.asarray(np.sqrt(np.nanmean(self.residuals**2, (0, 1))))


@dataclass
class _Refined:
    model: DeformingModel
    camera_from_base: Floats
    scale: Floats
    noise: Floats
    """(C,) standard deviation of a camera's coordinates in relation to the others': its rows are divided by it."""
    camera_variance: Floats
    """(C, 3) of the turns [rad2], the shapes taken as known."""
    steady: bool
    """The object, or the cameras, turn at a constant rate."""


def factorise_views(tracks: Floats) -> ManyViewShapes:
    """Find shapes, rotations and basis shapes from the tracks of several orthographic cameras that stand fixed.

    Args:
        tracks: (C, F, 2, P) the same points in all cameras at the same instants, each camera in a unit of its own; NaN
            where a camera does not see a point, also where it never does.

    Returns:
        The shapes.

    Raises:
        MareyError: There are too few cameras, frames or points, a frame or point is never seen, a camera
            shares too few points with the others, or all look from the same side.
    """
    tracks = np.asarray(tracks, float)
    _check(tracks)
    tracks, notes = checked_views(tracks)
    views = views_of(tracks, _check(tracks))
    best, others = best_angle(views)
    found = _tell(views, _refined(views, best), others, tracks)
    return replace(found, notes=(*notes, *_told_by(found)))


def _told_by(found: ManyViewShapes) -> tuple[str, ...]:
    notes = [RIGID] if found.rank == 1 else []
    worst = np.rad2deg(found.camera_sd.max())
    if worst > UNSURE:
        notes.append(
            f"How the cameras stand to each other is hardly told: to {worst:.0f} degrees. The object turns too little "
            "or deforms too much; the shapes are in doubt by as much in depth. A third camera would tell."
        )
    return tuple(notes)


def _check(tracks: Floats) -> Mask:
    if tracks.ndim != 4 or len(tracks) < 2:
        raise MareyError(f"Tracks have the shape {tracks.shape} and should have (cameras >= 2, frames, 2, points).")
    return checked(tracks, points=FEWEST_POINTS, frames=FEWEST_FRAMES)


def _refined(views: Views, best: Judged) -> _Refined:
    """Fit the model to all points of all cameras, for several numbers of modes; give the best."""
    even = np.ones(len(views.tracks))
    fits = [_fitted(views, best, modes, even) for modes in sorted({most_modes(modes, views) for modes in MODES})]
    fit = min(fits, key=lambda fit: fit.model.cost + PRICE * basis_cost(fit.model))
    rigid = _fitted(views, best, 0, even)
    # Noise alone fills modes, too.
    if rigid.model.cost <= min(fit.model.cost + PRICE_OF_DEFORMING * basis_cost(fit.model) for fit in fits):
        fit = rigid
    noise = _noise_of_cameras(views, fit)
    if noise.max() > UNEVEN * noise.min():
        fit = _fitted(views, best, len(fit.model.modes), noise / np.sqrt(np.mean(noise**2)))
    return fit


def _fitted(views: Views, best: Judged, modes: int, noise: Floats) -> _Refined:
    tracks, seen = stacked(views.tracks, noise)
    model = _begun(views, best, modes, noise)
    fit = _Refined(
        model, best.camera_from_base.copy(), best.scale.copy(), noise, np.zeros((len(noise), 3)), path_of(best)[2]
    )
    for _ in range(ROUNDS):
        improve(model, tracks, seen, 1)
        _turn_cameras(views, fit, tracks, seen)
    improve(model, tracks, seen, 1)
    return fit


def _begun(views: Views, best: Judged, modes: int, noise: Floats) -> DeformingModel:
    """Begin with the common points; the shapes of others follow from the frames of those."""
    common, points = views.common, views.tracks.shape[3]
    rotation, shapes, _ = path_of(best)
    projection = rows_of(best.camera_from_base, best.scale / noise)
    tracks, seen = stacked(views.tracks[..., common], noise)
    model = begin(tracks, seen, rotation, shapes, modes, FIRST_NOISE, projection)
    if len(common) < points:
        for name in ("mean", "modes"):
            part = getattr(model, name)
            whole = np.zeros((*part.shape[:-1], points))
            whole[..., common] = part
            setattr(model, name, whole)
        solve_shapes(model, *stacked(views.tracks, noise))
    return model


def _turn_cameras(views: Views, fit: _Refined, tracks: Floats, seen: Floats) -> None:
    """Do a Gauss-Newton step of every camera's rotation and scale, the shapes kept and the shifts free.

    Of two cameras the angle between the sights stays what its evidence made it: it hangs on the shapes and goes
    where they go.
    """
    model = fit.model
    carried = np.swapaxes(model.rotation @ model.shapes, 1, 2)
    for camera in set(range(len(fit.scale))) - {views.base[0]}:
        free = views.pair.second_axes[[0, 2]] if len(fit.scale) == 2 else np.eye(3)
        weight = seen[:, camera, :, None, None]
        own = slice(2 * camera, 2 * camera + 2)
        shown = carried @ model.projection[own].T
        left = np.swapaxes(tracks[:, own], 1, 2) - shown - model.shift[:, None, own]
        turned = carried @ fit.camera_from_base[camera].T
        by_turn = np.stack([np.cross(turned, axis) for axis in np.eye(3)[:2]], 2) @ free.T
        jacobian = np.concatenate([by_turn * fit.scale[camera] / fit.noise[camera], shown[..., None]], 3)
        count = np.maximum(weight.sum(1, keepdims=True), 1)
        jacobian = (jacobian - (jacobian * weight).sum(1, keepdims=True) / count) * weight
        flat = jacobian.reshape(-1, len(free) + 1)
        normal = flat.T @ flat
        step = np.linalg.solve(normal, flat.T @ left.ravel())
        fit.camera_from_base[camera] = rotations.exp(step[:-1] @ free) @ fit.camera_from_base[camera]
        fit.scale[camera] *= np.exp(step[-1])
        covariance = free.T @ np.linalg.inv(normal)[:-1, :-1] @ free
        fit.camera_variance[camera] = model.variance * np.diagonal(covariance)
    model.projection = rows_of(fit.camera_from_base, fit.scale / fit.noise)


def _noise_of_cameras(views: Views, fit: _Refined) -> Floats:
    """Estimate the standard deviation of a coordinate of each camera, in its size."""
    model = fit.model
    tracks, seen = stacked(views.tracks, fit.noise)
    residual, jacobian = residuals_and_jacobians(model, tracks, seen)
    doubt = np.einsum("frpd,fde,frpe->r", jacobian, model.covariance[0], jacobian, optimize=True)
    square = ((residual**2).sum((0, 2)) + doubt).reshape(-1, 2).sum(1) / (2 * seen.sum((0, 2)))
    return np.asarray(np.sqrt(square) * fit.noise)


def _disagreement(views: Views, fit: _Refined, others: list[Judged]) -> tuple[Floats, Floats, Floats]:
    """Say how answers differ whose angle lies a standard deviation away, each turned to fit the shapes best.

    Returns:
        Mean squares of the differences of the shapes (F, 3, P), of the turns about the first camera's axes (F, 3), and
        of the cameras' turns about their own (C, 3).
    """
    own, shapes = fit.camera_from_base[0] @ fit.model.rotation, fit.model.shapes
    relative = fit.camera_from_base @ fit.camera_from_base[0].T
    rows = np.concatenate(list(shapes), 1)
    of_shape, of_turn, of_camera = np.zeros(shapes.shape), np.zeros((len(shapes), 3)), np.zeros((len(relative), 3))
    for other in others:
        first = other.camera_from_base[0]
        rotation, theirs, _ = path_of(other)
        rotation = first @ rotation
        # one map of all frames' points, so that also those have a place that only one camera sees
        ours, known = (np.concatenate(list(x), 1) for x in ((own @ shapes)[:, :, views.common], rotation @ theirs))
        moved = np.swapaxes(rotation, 1, 2) @ (known @ np.linalg.pinv(ours)) @ own @ shapes
        turn = rotations.nearest(rows @ np.concatenate(list(moved), 1).T)
        of_shape += (turn @ moved - shapes) ** 2
        of_turn += rotations.log(rotation @ turn.T @ np.swapaxes(own, 1, 2)) ** 2
        theirs_relative = other.camera_from_base @ first.T
        of_camera += rotations.log(theirs_relative @ np.swapaxes(relative, 1, 2)) ** 2
    count = max(len(others), 1)
    return of_shape / count, of_turn / count, of_camera / count


def _doubt_of_path(model: DeformingModel, steady: bool) -> tuple[Floats, Floats]:
    """Say how far another motion may be meant: how much of a deformation is a turn of the whole, tracks do not tell.

    A turn as large as the departure from the mean shape is left open.

    Returns:
        Mean squares of the shapes' differences (F, 3, P) and of the turns (F, 3).
    """
    shapes = model.shapes
    mean = shapes.mean(0)
    points = np.swapaxes(model.rotation @ shapes, 1, 2)
    _, least, _ = mean_shape(points, np.ones(points.shape[:2], bool))
    moved = np.swapaxes(points @ least, 1, 2)
    if steady:
        turn = rotations.nearest(np.concatenate(list(shapes), 1) @ np.concatenate(list(moved), 1).T)
        apart = rotations.log(least @ turn.T @ np.swapaxes(model.rotation, 1, 2))
        return (SHARE_IN_DOUBT * (turn @ moved - shapes)) ** 2, (SHARE_IN_DOUBT * apart) ** 2
    open_turn = np.mean((shapes - mean) ** 2) / np.mean(mean**2)
    across = open_turn * ((mean**2).sum(0) - mean**2)
    return np.broadcast_to(across, shapes.shape), np.full((len(shapes), 3), open_turn)


def _tell(views: Views, fit: _Refined, others: list[Judged], tracks: Floats) -> ManyViewShapes:
    """Give the answer in the first camera's unit and axes, the object's axes those of its first frame."""
    model, first = fit.model, fit.camera_from_base[0]
    doubt = _disagreement(views, fit, others)
    unit = float(views.size[0] * fit.scale[0])
    turn = first @ model.rotation[0]
    rotation = first @ model.rotation @ turn.T
    coefficients, basis = _modes(model, turn, unit)
    shape = np.einsum("fk,kip->fip", coefficients, basis)
    camera_from_first = fit.camera_from_base @ first.T
    scale = fit.scale * views.size / unit
    shift = model.shift.reshape(len(shape), -1, 2).swapaxes(0, 1) * (fit.noise * views.size)[:, None, None]
    translation = np.where(np.asarray(views.seen.any(2))[..., None], shift + views.middle, np.nan)
    shown = np.einsum("cij,fjp->cfip", scale[:, None, None] * camera_from_first[:, :2], rotation @ shape)
    variance = shape_variance(model, stacked(views.tracks, fit.noise)[1])
    of_path, of_gauge = _doubt_of_path(model, fit.steady)
    of_turn = np.einsum("ij,fjk,ik->fi", first, model.covariance[0][:, :3, :3], first)
    camera_variance = fit.camera_variance + fit.camera_variance[0] + doubt[2]
    camera_variance[0] = 0
    return ManyViewShapes(
        shape=shape, shape_sd=np.sqrt(turn**2 @ (variance + doubt[0] + of_path)) * unit, rotation=rotation,
        rotation_sd=np.sqrt(of_turn + doubt[1] + of_gauge), camera_from_first=camera_from_first,
        camera_sd=np.sqrt(camera_variance), scale=scale, translation=translation, basis=basis,
        coefficients=coefficients, noise_sd=_noise_of_cameras(views, fit) * views.size,
        residuals=np.linalg.norm(tracks - shown - translation[..., None], axis=2),
        predicted=np.asarray(~views.seen.any(0)), notes=(),
    )  # fmt: skip


def _modes(model: DeformingModel, turn: Floats, unit: float) -> tuple[Floats, Floats]:
    """Give coefficients (F, K) and basis (K, 3, P): the mean, and by their size the modes that do something."""
    mean = model.mean + np.einsum("m,mip->ip", model.weights.mean(0), model.modes)
    frames, points = len(model.weights), mean.shape[1]
    left = np.einsum("fm,mip->fip", model.weights - model.weights.mean(0), model.modes).reshape(frames, -1)
    u, d, vt = np.linalg.svd(left, full_matrices=False)
    count = int((d[: len(model.modes)] > KEPT * np.sqrt(frames * points)).sum())
    coefficients = np.concatenate([np.ones((frames, 1)), u[:, :count] * d[:count] / np.sqrt(points) * unit], 1)
    modes = (vt[:count] * np.sqrt(points)).reshape(count, 3, points)
    return coefficients, np.concatenate([(turn @ mean * unit)[None], turn @ modes])
