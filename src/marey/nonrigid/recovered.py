"""Results of all factorisations in one form, over all frames and points, with their gauge in words."""

from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.errors import MareyError
from marey.nonrigid.in_space.calibrated import CalibratedShapes
from marey.nonrigid.in_space.factorisation import HomogeneousShapes
from marey.nonrigid.many_cameras.held_size import HeldSizeShapes
from marey.nonrigid.many_cameras.many_views import ManyViewShapes
from marey.nonrigid.many_cameras.scaled_orthographic import ScaledShapes
from marey.nonrigid.one_camera.one_view import NonRigidShapes
from marey.nonrigid.one_camera.perspective import PerspectiveShapes

ONE_VIEW = "one camera, orthographic"
"""Kind of result of `factorise_tracks`."""
SCALED_VIEW = "one camera, scaled orthographic"
"""Kind of result of `factorise_scaled`."""
PERSPECTIVE = "one camera, full perspective"
"""Kind of result of `factorise_perspective`."""
MANY_VIEWS = "several cameras, orthographic"
"""Kind of result of `factorise_views`."""
CALIBRATED = "several calibrated cameras"
"""Kind of result of `factorise_calibrated`."""
IN_SPACE = "points in space"
"""Kind of result of `factorise_points`."""

_MOTION = (
    "Motion and deformation: the motion is the one from which the points deviate least; displacements common to all "
    "points count as motion."
)
"""Gauge of results with a pose in space."""
_ONE_VIEW_GAUGE = (
    "Sign of depth: one orthographic camera does not distinguish a shape from its mirror image in depth; one of them "
    "is given.",
    "Scale: lengths are in the unit of the tracks; the size in space is unknown.",
    "Distance: unknown; the depth of the object's origin is set to zero.",
    "Global rotation: the object's axes are the camera's (x right, y down, z ahead) in the first frame with an "
    "estimate.",
)
"""Gauge of results of one orthographic camera."""
_IN_SPACE_GAUGE = (
    "Global rotation: the object's axes are the laboratory's in the first frame with a result; its origin is the "
    "centre of the mean shape.",
    _MOTION,
)
"""Gauge of results in the laboratory."""
GAUGES = {
    ONE_VIEW: _ONE_VIEW_GAUGE,
    SCALED_VIEW: _ONE_VIEW_GAUGE,
    PERSPECTIVE: (
        "Scale: a length is in pixels as seen at the object's mean distance; the size in space is unknown.",
        "Size and distance: a size that changes over time looks like a distance that changes; the size is assumed to "
        "change least.",
        "Global rotation: the object's axes are the camera's (x right, y down, z ahead) in the first frame with an "
        "estimate.",
        _MOTION,
    ),
    MANY_VIEWS: (
        "Sign of depth: any number of orthographic cameras does not distinguish a shape from its mirror image "
        "where their directions are mirrored too; one of them is given.",
        "Scale: lengths are in the unit of the first camera's tracks; the size in space is unknown.",
        "Distance: unknown; the depth of the object's origin is set to zero.",
        "Global rotation: the object's axes are the first camera's (x right, y down, z ahead) in the first frame with "
        "an estimate.",
    ),
    CALIBRATED: _IN_SPACE_GAUGE,
    IN_SPACE: _IN_SPACE_GAUGE,
}
"""By kind: what the data do not determine, and the convention that was chosen."""
IN_LABORATORY = (CALIBRATED, IN_SPACE)
"""Kinds whose motion is that in the laboratory, in its own unit."""
_OPEN = ("Scale", "Distance", "Size and distance", "Sign of depth")
"""Beginnings of the lines of a gauge that concern the shape itself, and not only the choice of axes."""
UNKNOWN_UNIT = "unit of the input"
"""Unit of results whose input has no known unit."""
INPUT_UNITS = " input units"
"""What follows a length whose unit is `UNKNOWN_UNIT`."""
HELD_SIZE = (
    "The object's size is held constant: its images are {least:.2f} to {most:.2f} times as large as on average, which "
    "is attributed to its distance."
)
"""Note of results with a magnification in each frame."""
_ARRAYS = (
    "shape", "shape_sd", "rotation", "rotation_sd", "translation", "basis", "coefficients", "residuals", "modelled",
    "noise_sd",
)  # fmt: skip
"""Fields of `RecoveredShapes` that hold numbers."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RankCurve:
    """Errors for several numbers of basis shapes, of which one was chosen."""

    ranks: Integers
    """(N,) numbers K of basis shapes, including the mean."""
    errors: Floats
    """(N,) error or cost of each number; less is better."""
    errors_sd: Floats
    """(N,) standard deviations of the errors; NaN where unknown."""
    measure: str
    """Description of the errors."""

    def __post_init__(self) -> None:
        freeze_fields(self, "ranks", dtype=np.int64)
        freeze_fields(self, "errors", "errors_sd")


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraRelations:
    """Relations of several uncalibrated cameras to the first one."""

    camera_from_first: Floats
    """(C, 3, 3) each camera from the first."""
    camera_sd: Floats
    """(C, 3) standard deviation of that rotation about the camera's own axes [rad]."""
    scale: Floats
    """(C,) scale of a camera over that of the first."""
    translation: Floats
    """(C, F, 2) image of the object's origin."""
    magnification: Floats
    """(F,) magnification of a frame in all cameras, 1 on average; all 1 where the size was not held constant."""

    def __post_init__(self) -> None:
        freeze_fields(self, "camera_from_first", "camera_sd", "scale", "translation", "magnification")


@dataclass(frozen=True, eq=False, kw_only=True)
class RecoveredShapes:
    """Shapes and motion of F frames and P points; NaN in frames and for points without an estimate."""

    kind: str
    """Kind of result, one of the keys of `GAUGES`."""
    shape: Floats
    """(F, 3, P) in the object's frame."""
    shape_sd: Floats
    """(F, 3, P) standard deviation of the shape."""
    rotation: Floats
    """(F, 3, 3) camera from object, of the first camera; from points in space, laboratory from object."""
    rotation_sd: Floats
    """(F, 3) standard deviation of the rotation [rad] about the camera's axes; from points in space about the
    object's."""
    translation: Floats
    """(F, 2) object's origin in the image of an orthographic camera, or (F, 3) in space."""
    basis: Floats
    """(K, 3, P) mean shape and modes; the shape is the sum of coefficients times basis."""
    coefficients: Floats
    """(F, K) weights of the basis shapes."""
    residuals: Floats
    """(C, F, P) distance of measurements from the model, by camera; NaN where nothing was measured."""
    predicted: Mask
    """(F, P) true where the shape includes a point that no camera saw."""
    modelled: Floats
    """(C, F, 2, P) images of the model's points; C = 0 from points in space."""
    noise_sd: Floats
    """(C,) standard deviation of a measured coordinate about the model, in its unit, by camera."""
    gauge: tuple[str, ...]
    """Conventions for what the data do not determine."""
    notes: tuple[str, ...] = ()
    """Notes for the user."""
    cameras: CameraRelations | None = None
    """Relations of several uncalibrated cameras."""
    curve: RankCurve | None = None
    """Errors for several numbers of basis shapes, where one was chosen."""
    unit: str = UNKNOWN_UNIT
    """Unit of the shape: px, m, or `UNKNOWN_UNIT`."""
    residual_unit: str = UNKNOWN_UNIT
    """Unit of the residuals and the noise."""
    path_ambiguity: Floats | None = None
    """(F, 3) deviation of other camera paths that explain the tracks of one orthographic camera nearly as well, root
    mean square [rad]; not part of the standard deviations."""
    metres_per_unit: float = float("nan")
    """Length of the shape's unit [m]; NaN where unknown."""
    metres_per_unit_sd: float = 0.0
    """Standard deviation of that length over the frames, where it results from a known distance."""

    def __post_init__(self) -> None:
        freeze_fields(self, *_ARRAYS)
        freeze_fields(self, "predicted", dtype=bool)
        if self.path_ambiguity is not None:
            freeze_fields(self, "path_ambiguity")

    def __len__(self) -> int:
        return len(self.shape)

    def length_text(self, value: float) -> str:
        """Format a length of the shape with its unit, in millimetres where the scale is known."""
        known = np.isfinite(self.metres_per_unit)
        return _with_unit(value * self.metres_per_unit, "m") if known else _with_unit(value, self.unit)

    def residual_text(self, value: float) -> str:
        """Format a residual with its unit."""
        return _with_unit(value, self.residual_unit)

    @property
    def undetermined(self) -> tuple[str, ...]:
        """What of size, place and depth of the object the data do not determine, as names in small letters."""
        begun = [line.partition(":")[0] for line in self.gauge]
        known = {"Scale"} if np.isfinite(self.metres_per_unit) else set()
        return tuple(name.lower() for name in _OPEN if name in begun and name not in known)

    @property
    def basis_shapes(self) -> int:
        """Number of basis shapes K, including the mean."""
        return len(self.basis)

    @property
    def rank(self) -> int:
        """Rank of the centred tracks or points of the model: 3 K; 3 for a rigid object."""
        return 3 * len(self.basis)

    @property
    def answered(self) -> Mask:
        """(F,) mask of the frames with an estimate."""
        return np.asarray(np.isfinite(self.rotation[:, 0, 0]))

    @property
    def origin(self) -> Floats:
        """(F, 3) object's origin; its depth before an orthographic camera is set to zero."""
        where = np.zeros((len(self), 3))
        where[:, : self.translation.shape[1]] = self.translation
        return where

    @property
    def placed(self) -> Floats:
        """(F, 3, P) shapes in the axes of the first camera or of the laboratory.

        Camera axes are x right, y down, z ahead. Before an orthographic camera the depth of the object's origin is
        zero.
        """
        return np.asarray(self.rotation @ self.shape + self.origin[:, :, None])

    @property
    def point_rms(self) -> Floats:
        """(P,) root mean square of each point's residuals; NaN for a point that was never measured."""
        seen = np.isfinite(self.residuals)
        total = (np.where(seen, self.residuals, 0) ** 2).sum((0, 1))
        count = seen.sum((0, 1))
        return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


def _with_unit(value: float, unit: str) -> str:
    """Format a length with its unit."""
    value = 1e3 * value if unit == "m" else value
    text = f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return text + {"m": " mm", "px": " px", UNKNOWN_UNIT: INPUT_UNITS}.get(unit, "")


def from_one_view(found: NonRigidShapes) -> RecoveredShapes:
    """Convert the result of one orthographic camera."""
    modelled = (found.rotation @ found.shape)[:, :2] + found.translation[:, :, None]
    return RecoveredShapes(
        kind=ONE_VIEW, shape=found.shape, shape_sd=found.shape_sd, rotation=found.rotation,
        rotation_sd=found.rotation_sd, translation=found.translation, basis=found.basis,
        coefficients=found.coefficients, residuals=found.residuals[None], predicted=found.predicted,
        modelled=modelled[None], noise_sd=np.array([found.noise_sd]), gauge=GAUGES[ONE_VIEW], notes=found.notes,
        path_ambiguity=found.path_ambiguity, curve=_evidence_curve(found.rank_curve),
    )  # fmt: skip


def _evidence_curve(curve: Floats) -> RankCurve:
    return RankCurve(
        ranks=curve[:, 0].astype(np.int64), errors=curve[:, 1], errors_sd=np.full(len(curve), np.nan),
        measure="how badly the tracks are explained, plus a cost of each shape (minus the logarithm of the "
        "probability, per coordinate)",
    )  # fmt: skip


def from_perspective(found: PerspectiveShapes, camera: Camera) -> RecoveredShapes:
    """Convert the result of one camera of known intrinsics.

    Args:
        found: The result.
        camera: The camera, placed at the origin, by which the points are projected.
    """
    modelled = camera.project(np.moveaxis(found.points, 1, 2))
    return RecoveredShapes(
        kind=PERSPECTIVE, shape=found.shape, shape_sd=found.shape_sd, rotation=found.rotation,
        rotation_sd=found.rotation_sd, translation=found.translation, basis=found.basis,
        coefficients=found.coefficients, residuals=found.residuals[None], predicted=found.predicted,
        modelled=np.moveaxis(modelled, 1, 2)[None], noise_sd=np.array([found.noise_sd]), gauge=GAUGES[PERSPECTIVE],
        notes=found.notes, unit="px", residual_unit="px",
    )  # fmt: skip


def from_calibrated(found: CalibratedShapes, rig: Rig) -> RecoveredShapes:
    """Convert the result of calibrated cameras; lengths are in metres, residuals in pixels."""
    modelled = np.stack([np.moveaxis(camera.project(found.points), 1, 2) for camera in rig])
    return RecoveredShapes(
        kind=CALIBRATED, shape=found.shape, shape_sd=found.shape_sd, rotation=found.rotation,
        rotation_sd=found.rotation_sd, translation=found.translation, basis=found.basis,
        coefficients=found.coefficients, residuals=found.residuals_px, predicted=found.predicted & (found.views == 0),
        modelled=modelled, noise_sd=np.full(len(rig), found.noise_px), gauge=GAUGES[CALIBRATED], notes=found.notes,
        curve=_curve_of(found, "distance of held-out pixels from their prediction, RMS [px]"),
        unit="m", residual_unit="px", metres_per_unit=1.0,
    )  # fmt: skip


def from_many_views(found: ManyViewShapes) -> RecoveredShapes:
    """Convert the result of several uncalibrated cameras."""
    turned = np.einsum("cij,fjp->cfip", found.camera_from_first, found.rotation @ found.shape)
    modelled = found.scale[:, None, None, None] * turned[:, :, :2] + found.translation[..., None]
    relations = CameraRelations(
        camera_from_first=found.camera_from_first, camera_sd=found.camera_sd, scale=found.scale,
        translation=found.translation, magnification=np.ones(len(found.shape)),
    )  # fmt: skip
    return RecoveredShapes(
        kind=MANY_VIEWS, shape=found.shape, shape_sd=found.shape_sd, rotation=found.rotation,
        rotation_sd=found.rotation_sd, translation=found.translation[0], basis=found.basis,
        coefficients=found.coefficients, residuals=found.residuals, predicted=found.predicted, modelled=modelled,
        noise_sd=found.noise_sd, gauge=GAUGES[MANY_VIEWS], notes=found.notes, cameras=relations,
    )  # fmt: skip


def from_held_size(found: HeldSizeShapes) -> RecoveredShapes:
    """Convert the result of several uncalibrated cameras with a magnification in each frame."""
    plain, size = from_many_views(found.shapes), found.magnification
    assert plain.cameras is not None
    translation = found.shapes.translation * size[:, None]
    cameras = replace(plain.cameras, translation=translation, magnification=size)
    notes = plain.notes
    if np.ptp(size) > 0:
        notes = (*notes, HELD_SIZE.format(least=size.min(), most=size.max()))
    return replace(
        plain, modelled=plain.modelled * size[:, None, None], residuals=plain.residuals * size[:, None],
        translation=translation[0], cameras=cameras, notes=notes,
    )  # fmt: skip


def from_scaled(found: ScaledShapes) -> RecoveredShapes:
    """Convert the result of one camera with a magnification in each frame."""
    plain, size = from_one_view(found.in_tracks_unit), found.magnification
    turned = (plain.rotation @ plain.shape)[:, :2] * size[:, None, None]
    relations = CameraRelations(
        camera_from_first=np.eye(3)[None], camera_sd=np.zeros((1, 3)), scale=np.ones(1),
        translation=plain.translation[None], magnification=size,
    )  # fmt: skip
    return replace(
        plain, kind=SCALED_VIEW, modelled=(turned + plain.translation[..., None])[None], cameras=relations,
        gauge=GAUGES[SCALED_VIEW], notes=(*plain.notes, HELD_SIZE.format(least=size.min(), most=size.max())),
    )  # fmt: skip


def from_points(found: HomogeneousShapes) -> RecoveredShapes:
    """Convert the result from points in space."""
    frames, _, points = found.shape.shape
    curve = _curve_of(found, "distance of held-out points from their prediction, RMS")
    return RecoveredShapes(
        kind=IN_SPACE, shape=found.shape, shape_sd=found.shape_sd, rotation=found.rotation,
        rotation_sd=found.rotation_sd, translation=found.translation, basis=found.basis,
        coefficients=found.coefficients, residuals=found.residuals[None], predicted=found.predicted,
        modelled=np.zeros((0, frames, 2, points)), noise_sd=np.array([found.noise_sd]), gauge=GAUGES[IN_SPACE],
        notes=found.notes, curve=curve,
    )  # fmt: skip


def _curve_of(found: HomogeneousShapes, measure: str) -> RankCurve | None:
    if found.choice is None:
        return None
    choice = found.choice
    return RankCurve(
        ranks=choice.ranks, errors=choice.held_out_rms, errors_sd=choice.held_out_sd, measure=measure
    )  # fmt: skip


def usable_places(seen: Mask, *, least_points: int, least_frames: int) -> tuple[Mask, Mask]:
    """Find the frames and points with enough measurements, excluding others until convergence.

    Args:
        seen: (C, F, P) mask by camera.
        least_points: Least number of points that at least one camera must see in a frame.
        least_frames: Least number of frames in which a point must be seen.

    Returns:
        Masks of the frames (F,) and points (P,) that are kept.

    Raises:
        MareyError: Too few frames or points are left.
    """
    frames, points = np.ones(seen.shape[1], bool), np.ones(seen.shape[2], bool)
    while True:
        kept = seen & frames[:, None] & points
        enough, often = kept.sum(2).max(0) >= least_points, kept.any(0).sum(0) >= least_frames
        if (enough == frames).all() and (often == points).all():
            break
        frames, points = enough, often
    if frames.sum() < least_frames or points.sum() < least_points:
        count, shown = int(seen.any((0, 1)).sum()), int(seen.any((0, 2)).sum())
        raise MareyError(
            f"{count} points over {shown} frames are too few: at least {least_points} points must be seen together "
            f"in at least {least_frames} frames."
        )
    return frames, points


def expanded(found: RecoveredShapes, frames: Mask, points: Mask) -> RecoveredShapes:
    """Insert a result for some frames and points among all of them; the others are NaN.

    Args:
        found: Result for the selected frames and points.
        frames: (F,) mask of the selected frames.
        points: (P,) mask of the selected points.
    """
    if frames.all() and points.all():
        return found

    def wide(values: np.ndarray, *kept: Mask | None) -> np.ndarray:
        """Expand the axes for which a mask is given."""
        axes = [np.ones(n, bool) if mask is None else mask for n, mask in zip(values.shape, kept, strict=True)]
        full = np.full([len(mask) for mask in axes], False if values.dtype == bool else np.nan)
        full[np.ix_(*axes)] = values
        return full

    cameras = found.cameras
    if cameras is not None:
        cameras = replace(
            cameras, translation=wide(cameras.translation, None, frames, None),
            magnification=wide(cameras.magnification, frames),
        )  # fmt: skip
    path_ambiguity = None if found.path_ambiguity is None else wide(found.path_ambiguity, frames, None)
    return replace(
        found, cameras=cameras, path_ambiguity=path_ambiguity, shape=wide(found.shape, frames, None, points),
        shape_sd=wide(found.shape_sd, frames, None, points),
        rotation=wide(found.rotation, frames, None, None), rotation_sd=wide(found.rotation_sd, frames, None),
        translation=wide(found.translation, frames, None), basis=wide(found.basis, None, None, points),
        coefficients=wide(found.coefficients, frames, None), residuals=wide(found.residuals, None, frames, points),
        predicted=wide(found.predicted, frames, points), modelled=wide(found.modelled, None, frames, None, points),
    )  # fmt: skip


def with_known_distance(found: RecoveredShapes, first: int, second: int, metres: float) -> RecoveredShapes:
    """Set the scale of the shapes from a known distance between two points.

    The median of their distance over the frames is used, since the two may move relative to each other and depth is
    noisy.

    Args:
        found: The shapes.
        first: Index of a point, counted from 0.
        second: Index of another point.
        metres: Distance between the two [m].

    Raises:
        MareyError: The points are not two different points with an estimate, or the distance is not positive.
    """
    count = found.shape.shape[2]
    if not (np.isfinite(metres) and metres > 0):
        raise MareyError(f"The known distance is {metres:g} m; expected a value above 0.")
    if first == second or not (0 <= first < count and 0 <= second < count):
        raise MareyError(
            f"The known distance is between the points {first} and {second}; expected two different points of 0 to "
            f"{count - 1}."
        )
    apart = np.linalg.norm(found.shape[:, :, first] - found.shape[:, :, second], axis=1)
    apart = apart[np.isfinite(apart)]
    middle = float(np.median(apart)) if len(apart) else 0.0
    if not middle > 0:
        raise MareyError(
            f"The points {first} and {second} are never known in the same frame, so that their distance sets no scale."
        )
    spread = float(np.std(apart)) / middle
    note = (
        f"Scale: the distance of {metres:g} m between the points {first} and {second} was given; it varies by "
        f"{100 * spread:.1f} % over the frames, and its median sets the scale."
    )
    return replace(
        found, metres_per_unit=metres / middle, metres_per_unit_sd=spread * metres / middle,
        gauge=tuple(line for line in found.gauge if not line.startswith("Scale:")) + (note,),
    )  # fmt: skip
