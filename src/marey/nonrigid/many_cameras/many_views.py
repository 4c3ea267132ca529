"""Shape and motion of a deforming object before several uncalibrated cameras that are fixed to each other.

The model is that of [Alexander2003] eq. (13) and (14): the cameras share the coefficients of the deformation and one
rotation per frame. Unlike the paper, which factors the stacked tracks and enforces the fixed relative rotations
afterwards, these are part of the model from the start: the tracks of two cameras determine their relative orientation
up to one angle, and that angle is chosen by the probability of the tracks under a Gaussian model of a deforming shape
(`deforming_model`).
"""

from dataclasses import dataclass, field, replace

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.errors import MareyError
from marey.geometry import rotations
from marey.nonrigid.core.alignment import mean_shape
from marey.nonrigid.core.deforming_model import (
    DeformingModel,
    basis_cost,
    initial_model,
    refine,
    residuals_and_jacobians,
    shape_variance,
    solve_shapes,
)
from marey.nonrigid.core.refinement import FEWEST_FRAMES, RefinementSettings
from marey.nonrigid.core.track_checks import FEWEST_POINTS, RIGID, check_tracks
from marey.nonrigid.many_cameras.view_angle import (
    CameraArrangement,
    NormalisedViews,
    ViewAngleSettings,
    best_angle,
    initial_motion,
    most_modes,
    normalised_views,
    stacked,
)
from marey.nonrigid.many_cameras.view_checks import ViewCheckSettings, checked_views
from marey.nonrigid.many_cameras.view_geometry import rows_of


@dataclass(frozen=True, kw_only=True)
class ManyViewSettings:
    """Settings of the factorisation of several orthographic cameras' tracks.

    Where nothing else is stated, defaults were chosen by hand, and results were not measured against other values.
    """

    steady_uncertainty: float = 0.7
    """Standard deviation of a rotation of constant rate, as a fraction of its difference from the motion of least
    departure."""
    uneven_noise: float = 1.2
    """Cameras are weighted by their noise where the largest is more than this times the smallest."""
    uncertain_angle_deg: float = 10.0
    """A note is given where the standard deviation of a camera's rotation exceeds this [degrees]."""
    refinement: RefinementSettings = field(default_factory=RefinementSettings)
    """Settings of the final fit."""
    angle: ViewAngleSettings = field(default_factory=ViewAngleSettings)
    """Settings of the search for the angle between two cameras."""
    checks: ViewCheckSettings = field(default_factory=ViewCheckSettings)
    """Settings of the checks of the tracks."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ManyViewShapes:
    """Shapes and motion before several cameras.

    The tracks of camera c in frame f are the first two rows of
    scale[c] * camera_from_first[c] @ rotation[f] @ shape[f], plus translation[c, f]. What orthographic cameras do not
    determine, in any number, is chosen by convention: one of the two mirror images (depth and relative
    rotations mirrored together), the object's axes, which are the first camera's in the first frame, and the unit, that
    of the first camera's tracks.
    """

    shape: Floats
    """(F, 3, P) in the object's frame, including points that were not seen (`predicted`)."""
    shape_sd: Floats
    """(F, 3, P) standard deviation of the shape."""
    rotation: Floats
    """(F, 3, 3) first camera from object."""
    rotation_sd: Floats
    """(F, 3) standard deviation of the rotation about the first camera's axes [rad]."""
    camera_from_first: Floats
    """(C, 3, 3) each camera from the first."""
    camera_sd: Floats
    """(C, 3) standard deviation of that rotation about the camera's own axes [rad]; 0 for the first."""
    scale: Floats
    """(C,) scale of a camera over that of the first."""
    translation: Floats
    """(C, F, 2) image of the object's origin; NaN where a camera sees nothing of a frame."""
    basis: Floats
    """(K, 3, P) mean shape, and modes of root mean square 1 per point, the largest first."""
    coefficients: Floats
    """(F, K) weights of the basis shapes; the first is 1."""
    noise_sd: Floats
    """(C,) standard deviation of a coordinate of a camera's tracks about the model."""
    residuals: Floats
    """(C, F, P) distance of each seen point from the model; NaN where not seen."""
    predicted: Mask
    """(F, P) true where the shape includes a point that no camera saw."""
    notes: tuple[str, ...]
    """Notes for the user."""

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
        """Number of basis shapes K, including the mean."""
        return len(self.basis)

    @property
    def point_rms(self) -> Floats:
        """(P,) root mean square distance of each point from the model."""
        return np.asarray(np.sqrt(np.nanmean(self.residuals**2, (0, 1))))


@dataclass
class _ManyViewFit:
    """Model and cameras, changed in place while they are refined."""

    model: DeformingModel
    camera_from_base: Floats
    """(C, 3, 3) each camera from the first of the base."""
    scale: Floats
    """(C,) scale of each camera over that of the first of the base."""
    noise: Floats
    """(C,) relative standard deviation of each camera's coordinates, by which its rows are divided."""
    camera_variance: Floats
    """(C, 3) variance of the cameras' rotations [rad2], given the shapes."""
    steady: bool
    """True where the object, or the cameras, rotate at a constant rate."""


def factorise_views(tracks: Floats, settings: ManyViewSettings = ManyViewSettings()) -> ManyViewShapes:
    """Estimate shapes, rotations and basis shapes from the tracks of several fixed orthographic cameras.

    Args:
        tracks: (C, F, 2, P) of the same points in all cameras at the same instants, each camera in its own unit; NaN
            where a camera does not see a point, including points that it never sees.
        settings: Tuned constants of the algorithm.

    Returns:
        The shapes.

    Raises:
        MareyError: There are too few cameras, frames or points, a frame or point is never seen, a camera
            shares too few points with the others, or all look from the same side.
    """
    tracks = np.asarray(tracks, float)
    _check(tracks)
    tracks, notes = checked_views(tracks, settings.checks)
    views = normalised_views(tracks, _check(tracks), settings.angle)
    best, others = best_angle(views, settings.angle)
    found = _result(views, _refined(views, best, settings), others, tracks, settings)
    return replace(found, notes=(*notes, *_result_notes(found, settings.uncertain_angle_deg)))


def _result_notes(found: ManyViewShapes, uncertain: float) -> tuple[str, ...]:
    notes = [RIGID] if found.rank == 1 else []
    worst = np.rad2deg(found.camera_sd.max())
    if worst > uncertain:
        notes.append(
            f"The relative orientation of the cameras is determined only to {worst:.0f} degrees: the object rotates "
            "too little or deforms too much. The depth of the shapes is uncertain accordingly. Add a third camera."
        )
    return tuple(notes)


def _check(tracks: Floats) -> Mask:
    if tracks.ndim != 4 or len(tracks) < 2:
        raise MareyError(f"Tracks have shape {tracks.shape}; expected (cameras >= 2, frames, 2, points).")
    return check_tracks(tracks, points=FEWEST_POINTS, frames=FEWEST_FRAMES)


def _refined(views: NormalisedViews, best: CameraArrangement, settings: ManyViewSettings) -> _ManyViewFit:
    """Fit the model to all points of all cameras with several numbers of modes, and select the best fit."""
    even, refinement = np.ones(len(views.tracks)), settings.refinement
    counts = sorted({most_modes(modes, views, settings.angle) for modes in refinement.mode_counts})
    fits = [_fitted(views, best, modes, even, settings) for modes in counts]
    fit = min(fits, key=lambda fit: fit.model.cost + refinement.cost_share * basis_cost(fit.model))
    rigid = _fitted(views, best, 0, even, settings)
    # Noise alone also fills modes.
    if rigid.model.cost <= min(fit.model.cost + refinement.rigid_cost_share * basis_cost(fit.model) for fit in fits):
        fit = rigid
    noise = _noise_of_cameras(views, fit)
    if noise.max() > settings.uneven_noise * noise.min():
        fit = _fitted(views, best, len(fit.model.modes), noise / np.sqrt(np.mean(noise**2)), settings)
    return fit


def _fitted(
    views: NormalisedViews, best: CameraArrangement, modes: int, noise: Floats, settings: ManyViewSettings
) -> _ManyViewFit:
    """Fit model and cameras for a number of modes and relative noise (C,) of the cameras."""
    tracks, seen = stacked(views.tracks, noise)
    model, steady = _initial_model(views, best, modes, noise, settings)
    fit = _ManyViewFit(
        model, best.camera_from_base.copy(), best.scale.copy(), noise, np.zeros((len(noise), 3)), steady
    )  # fmt: skip
    for _ in range(settings.refinement.rounds):
        refine(model, tracks, seen, 1)
        _refine_cameras(views, fit, tracks, seen)
    refine(model, tracks, seen, 1)
    return fit


def _initial_model(
    views: NormalisedViews, best: CameraArrangement, modes: int, noise: Floats, settings: ManyViewSettings
) -> tuple[DeformingModel, bool]:
    """Create a model from the common points, and add the others by the motion of these; also whether it is steady."""
    common, points = views.common, views.tracks.shape[3]
    rotation, shapes, steady = initial_motion(best, settings.angle)
    projection = rows_of(best.camera_from_base, best.scale / noise)
    tracks, seen = stacked(views.tracks[..., common], noise)
    model = initial_model(
        tracks, seen, rotation, shapes, modes, settings.refinement.initial_noise, projection, settings.angle.model
    )  # fmt: skip
    if len(common) < points:
        for name in ("mean", "modes"):
            part = getattr(model, name)
            whole = np.zeros((*part.shape[:-1], points))
            whole[..., common] = part
            setattr(model, name, whole)
        solve_shapes(model, *stacked(views.tracks, noise))
    return model, steady


def _refine_cameras(views: NormalisedViews, fit: _ManyViewFit, tracks: Floats, seen: Floats) -> None:
    """Do a Gauss-Newton step of each camera's rotation and scale, with fixed shapes and free shifts.

    For two cameras the angle between the lines of sight is kept: it is strongly correlated with the shapes and would
    follow them.
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


def _noise_of_cameras(views: NormalisedViews, fit: _ManyViewFit) -> Floats:
    """Estimate the noise (C,) of each camera's coordinates, in units of its size."""
    """Estimate the standard deviation of a coordinate of each camera, in its size."""
    model = fit.model
    tracks, seen = stacked(views.tracks, fit.noise)
    residual, jacobian = residuals_and_jacobians(model, tracks, seen)
    uncertainty = np.einsum("frpd,fde,frpe->r", jacobian, model.covariance[0], jacobian, optimize=True)
    square = ((residual**2).sum((0, 2)) + uncertainty).reshape(-1, 2).sum(1) / (2 * seen.sum((0, 2)))
    return np.asarray(np.sqrt(square) * fit.noise)


def _squared_differences(
    views: NormalisedViews, fit: _ManyViewFit, others: list[CameraArrangement], settings: ViewAngleSettings
) -> tuple[Floats, Floats, Floats]:
    """Compute the differences of solutions one standard deviation of the angle away, each rotated to fit best.

    Returns:
        Mean squares of the differences of the shapes (F, 3, P), of the rotations about the first camera's axes (F, 3),
        and of the cameras' rotations about their own axes (C, 3).
    """
    own, shapes = fit.camera_from_base[0] @ fit.model.rotation, fit.model.shapes
    relative = fit.camera_from_base @ fit.camera_from_base[0].T
    rows = np.concatenate(list(shapes), 1)
    of_shape, of_turn, of_camera = np.zeros(shapes.shape), np.zeros((len(shapes), 3)), np.zeros((len(relative), 3))
    for other in others:
        first = other.camera_from_base[0]
        rotation, theirs, _ = initial_motion(other, settings)
        rotation = first @ rotation
        # one map for the points of all frames, so that it also applies to points that only one camera sees
        ours, known = (np.concatenate(list(x), 1) for x in ((own @ shapes)[:, :, views.common], rotation @ theirs))
        moved = np.swapaxes(rotation, 1, 2) @ (known @ np.linalg.pinv(ours)) @ own @ shapes
        turn = rotations.nearest(rows @ np.concatenate(list(moved), 1).T)
        of_shape += (turn @ moved - shapes) ** 2
        of_turn += rotations.log(rotation @ turn.T @ np.swapaxes(own, 1, 2)) ** 2
        theirs_relative = other.camera_from_base @ first.T
        of_camera += rotations.log(theirs_relative @ np.swapaxes(relative, 1, 2)) ** 2
    count = max(len(others), 1)
    return of_shape / count, of_turn / count, of_camera / count


def _motion_ambiguity(model: DeformingModel, steady: bool, uncertainty: float) -> tuple[Floats, Floats]:
    """Compute the ambiguity between motion and deformation, which tracks do not resolve.

    A rotation as large as the departure from the mean shape is taken as undetermined.

    Args:
        model: The fitted model.
        steady: Whether a rotation of constant rate was chosen.
        uncertainty: Fraction of the difference from the motion of least departure that is then uncertain.

    Returns:
        Mean squares of the shapes' differences (F, 3, P) and of the rotations (F, 3).
    """
    shapes = model.shapes
    mean = shapes.mean(0)
    points = np.swapaxes(model.rotation @ shapes, 1, 2)
    _, least, _ = mean_shape(points, np.ones(points.shape[:2], bool))
    moved = np.swapaxes(points @ least, 1, 2)
    if steady:
        turn = rotations.nearest(np.concatenate(list(shapes), 1) @ np.concatenate(list(moved), 1).T)
        apart = rotations.log(least @ turn.T @ np.swapaxes(model.rotation, 1, 2))
        return (uncertainty * (turn @ moved - shapes)) ** 2, (uncertainty * apart) ** 2
    open_turn = np.mean((shapes - mean) ** 2) / np.mean(mean**2)
    across = open_turn * ((mean**2).sum(0) - mean**2)
    return np.broadcast_to(across, shapes.shape), np.full((len(shapes), 3), open_turn)


def _result(
    views: NormalisedViews,
    fit: _ManyViewFit,
    others: list[CameraArrangement],
    tracks: Floats,
    settings: ManyViewSettings,
) -> ManyViewShapes:
    """Convert the fit to the first camera's unit and axes, with the object's axes those of its first frame."""
    model, first = fit.model, fit.camera_from_base[0]
    of_angle = _squared_differences(views, fit, others, settings.angle)
    unit = float(views.size[0] * fit.scale[0])
    turn = first @ model.rotation[0]
    rotation = first @ model.rotation @ turn.T
    coefficients, basis = _ordered_modes(model, turn, unit, settings.refinement.least_mode_size)
    shape = np.einsum("fk,kip->fip", coefficients, basis)
    camera_from_first = fit.camera_from_base @ first.T
    scale = fit.scale * views.size / unit
    shift = model.shift.reshape(len(shape), -1, 2).swapaxes(0, 1) * (fit.noise * views.size)[:, None, None]
    translation = np.where(np.asarray(views.seen.any(2))[..., None], shift + views.middle, np.nan)
    shown = np.einsum("cij,fjp->cfip", scale[:, None, None] * camera_from_first[:, :2], rotation @ shape)
    variance = shape_variance(model, stacked(views.tracks, fit.noise)[1])
    of_path, of_gauge = _motion_ambiguity(model, fit.steady, settings.steady_uncertainty)
    of_turn = np.einsum("ij,fjk,ik->fi", first, model.covariance[0][:, :3, :3], first)
    camera_variance = fit.camera_variance + fit.camera_variance[0] + of_angle[2]
    camera_variance[0] = 0
    return ManyViewShapes(
        shape=shape, shape_sd=np.sqrt(turn**2 @ (variance + of_angle[0] + of_path)) * unit, rotation=rotation,
        rotation_sd=np.sqrt(of_turn + of_angle[1] + of_gauge), camera_from_first=camera_from_first,
        camera_sd=np.sqrt(camera_variance), scale=scale, translation=translation, basis=basis,
        coefficients=coefficients, noise_sd=_noise_of_cameras(views, fit) * views.size,
        residuals=np.linalg.norm(tracks - shown - translation[..., None], axis=2),
        predicted=np.asarray(~views.seen.any(0)), notes=(),
    )  # fmt: skip


def _ordered_modes(model: DeformingModel, turn: Floats, unit: float, least: float) -> tuple[Floats, Floats]:
    """Compute coefficients (F, K) and basis (K, 3, P): the mean, and the modes above the least size, largest first."""
    mean = model.mean + np.einsum("m,mip->ip", model.weights.mean(0), model.modes)
    frames, points = len(model.weights), mean.shape[1]
    left = np.einsum("fm,mip->fip", model.weights - model.weights.mean(0), model.modes).reshape(frames, -1)
    u, d, vt = np.linalg.svd(left, full_matrices=False)
    count = int((d[: len(model.modes)] > least * np.sqrt(frames * points)).sum())
    coefficients = np.concatenate([np.ones((frames, 1)), u[:, :count] * d[:count] / np.sqrt(points) * unit], 1)
    modes = (vt[:count] * np.sqrt(points)).reshape(count, 3, points)
    return coefficients, np.concatenate([(turn @ mean * unit)[None], turn @ modes])
