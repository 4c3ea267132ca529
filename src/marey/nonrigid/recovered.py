"""What any factorisation found, in one form: over all frames and points, with what had to be chosen said in words."""

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
SCALED_VIEW = "one camera, scaled orthographic"
PERSPECTIVE = "one camera, full perspective"
MANY_VIEWS = "several cameras, orthographic"
CALIBRATED = "several calibrated cameras"
IN_SPACE = "points in space"

_MOTION = (
    "Motion and deformation: the motion is the one from which the points depart least; what all points do together "
    "counts as motion."
)
GAUGES = {
    ONE_VIEW: (
        "Sign of depth: one orthographic camera sees a shape and its mirror image in depth alike; one is given.",
        "Scale: lengths are in the unit of the tracks; the size in space is not known.",
        "Distance: not known; the depth of the object's origin is called zero.",
        "Global rotation: the object's axes are the camera's (x right, y down, z ahead) in the first frame that has an "
        "answer.",
    ),
    PERSPECTIVE: (
        "Scale: a length is in pixels as it is seen at the object's mean distance; the size in space is not known.",
        "Size and distance: a size that changes over time looks like a distance that changes; the size is believed to "
        "change the least.",
        "Global rotation: the object's axes are the camera's (x right, y down, z ahead) in the first frame that has an "
        "answer.",
        _MOTION,
    ),
    MANY_VIEWS: (
        "Sign of depth: orthographic cameras, however many, see a shape and its mirror image alike where their "
        "directions are mirrored with it; one is given.",
        "Scale: lengths are in the unit of the first camera's tracks; the size in space is not known.",
        "Distance: not known; the depth of the object's origin is called zero.",
        "Global rotation: the object's axes are the first camera's (x right, y down, z ahead) in the first frame that "
        "has an answer.",
    ),
    IN_SPACE: (
        "Global rotation: the object's axes are the laboratory's in the first frame that has an answer; its origin is "
        "the centre of the mean shape.",
        _MOTION,
    ),
}
GAUGES[SCALED_VIEW] = GAUGES[ONE_VIEW]
GAUGES[CALIBRATED] = GAUGES[IN_SPACE]
"""By kind: what the data cannot tell, and what was chosen instead."""
IN_LABORATORY = (CALIBRATED, IN_SPACE)
"""Kinds whose motion is that in the laboratory, in its own unit."""
UNSAID = "unit of the input"
HELD = (
    "The object's size is held: that its pictures are {least:.2f} to {most:.2f} times as large as on average is put "
    "down to its distance."
)
_ARRAYS = (
    "shape", "shape_sd", "rotation", "rotation_sd", "translation", "basis", "coefficients", "residuals", "modelled",
    "noise_sd",
)  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class RankCurve:
    """How well numbers of basis shapes explain what was held back, and which was taken."""

    ranks: Integers
    """(N,) numbers K of basis shapes, the mean among them."""
    errors: Floats
    """(N,) what they were judged by; less is better."""
    errors_sd: Floats
    """(N,) standard deviations; NaN where not known."""
    measure: str
    """What the errors are, in words."""

    def __post_init__(self) -> None:
        freeze_fields(self, "ranks", dtype=np.int64)
        freeze_fields(self, "errors", "errors_sd")


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraRelations:
    """How several uncalibrated cameras stand to the first one."""

    camera_from_first: Floats
    """(C, 3, 3)."""
    camera_sd: Floats
    """(C, 3) of that turn about the camera's own axes [rad]."""
    scale: Floats
    """(C,) of a camera over the first."""
    translation: Floats
    """(C, F, 2)."""
    magnification: Floats
    """(F,) how large a frame's pictures are in all cameras, 1 on average; all 1 where the size was not held."""

    def __post_init__(self) -> None:
        freeze_fields(self, "camera_from_first", "camera_sd", "scale", "translation", "magnification")


@dataclass(frozen=True, eq=False, kw_only=True)
class RecoveredShapes:
    """Shapes and motion of F frames and P points; NaN in frames, and for points, that have no answer."""

    kind: str
    """One of `GAUGES`."""
    shape: Floats
    """(F, 3, P) in the object's frame."""
    shape_sd: Floats
    """(F, 3, P)."""
    rotation: Floats
    """(F, 3, 3) camera from object, of the first camera; from points in space, laboratory from object."""
    rotation_sd: Floats
    """(F, 3) [rad] about the camera's axes; from points in space about the object's."""
    translation: Floats
    """(F, 2) in the picture of an orthographic camera, or (F, 3)."""
    basis: Floats
    """(K, 3, P) the mean shape and displacements; shape = sum of coefficients times basis."""
    coefficients: Floats
    """(F, K)."""
    residuals: Floats
    """(C, F, P) distance of what was measured from the model, by camera; NaN where nothing was."""
    predicted: Mask
    """(F, P) true where a shape is given of a point that no camera saw."""
    modelled: Floats
    """(C, F, 2, P) where the model puts the points in the pictures; C = 0 from points in space."""
    noise_sd: Floats
    """(C,) of a measured coordinate about the model, in its unit, by camera."""
    gauge: tuple[str, ...]
    """What was chosen because nothing tells it."""
    notes: tuple[str, ...] = ()
    """What a user should know of this answer."""
    cameras: CameraRelations | None = None
    """Of several uncalibrated cameras."""
    curve: RankCurve | None = None
    """How the number of basis shapes was chosen, where that leaves a curve."""
    unit: str = UNSAID
    """Of the shape: px, m, or that nobody says it."""
    residual_unit: str = UNSAID
    """Of the residuals and the noise."""
    path_doubt: Floats | None = None
    """(F, 3) of one orthographic camera: how far other camera paths that explain the tracks nearly as well turn away
    from this one, root mean square [rad]; not in the standard deviations."""
    metres_per_unit: float = float("nan")
    """Of the shape; NaN where no length is known."""
    metres_per_unit_sd: float = 0.0
    """Spread of that over the frames, where it was found from a known distance."""

    def __post_init__(self) -> None:
        freeze_fields(self, *_ARRAYS)
        freeze_fields(self, "predicted", dtype=bool)
        if self.path_doubt is not None:
            freeze_fields(self, "path_doubt")

    def __len__(self) -> int:
        return len(self.shape)

    def length_text(self, value: float) -> str:
        """Write a length of the shape as people read it, in millimetres where the scale is known."""
        known = np.isfinite(self.metres_per_unit)
        return _with_unit(value * self.metres_per_unit, "m") if known else _with_unit(value, self.unit)

    def residual_text(self, value: float) -> str:
        """Write a residual as people read it."""
        return _with_unit(value, self.residual_unit)

    @property
    def basis_shapes(self) -> int:
        """K, with the mean."""
        return len(self.basis)

    @property
    def rank(self) -> int:
        """Rank of the centred tracks, or points, that the model stands for: 3 K; 3 for a rigid object."""
        return 3 * len(self.basis)

    @property
    def answered(self) -> Mask:
        """(F,) which frames have an answer."""
        return np.asarray(np.isfinite(self.rotation[:, 0, 0]))

    @property
    def origin(self) -> Floats:
        """(F, 3) the object's origin; its depth before an orthographic camera is called zero."""
        where = np.zeros((len(self), 3))
        where[:, : self.translation.shape[1]] = self.translation
        return where

    @property
    def placed(self) -> Floats:
        """(F, 3, P) the shapes where they are, in the axes of the first camera or of the laboratory.

        A camera's are x right, y down, z ahead. Before an orthographic camera the depth of the object's origin is zero.
        """
        return np.asarray(self.rotation @ self.shape + self.origin[:, :, None])

    @property
    def point_rms(self) -> Floats:
        """(P,) root mean square of each point's residuals; NaN for one that was never measured."""
        seen = np.isfinite(self.residuals)
        total = (np.where(seen, self.residuals, 0) ** 2).sum((0, 1))
        count = seen.sum((0, 1))
        return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


def _with_unit(value: float, unit: str) -> str:
    """Write a length as people read it."""
    value = 1e3 * value if unit == "m" else value
    text = f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return text + {"m": " mm", "px": " px"}.get(unit, "")


def from_one_view(found: NonRigidShapes) -> RecoveredShapes:
    """Take over what one orthographic camera told."""
    modelled = (found.rotation @ found.shape)[:, :2] + found.translation[:, :, None]
    return RecoveredShapes(
        kind=ONE_VIEW, shape=found.shape, shape_sd=found.shape_sd, rotation=found.rotation,
        rotation_sd=found.rotation_sd, translation=found.translation, basis=found.basis,
        coefficients=found.coefficients, residuals=found.residuals[None], predicted=found.predicted,
        modelled=modelled[None], noise_sd=np.array([found.noise_sd]), gauge=GAUGES[ONE_VIEW], notes=found.notes,
        path_doubt=found.path_doubt, curve=_evidence_curve(found.rank_curve),
    )  # fmt: skip


def _evidence_curve(curve: Floats) -> RankCurve:
    return RankCurve(
        ranks=curve[:, 0].astype(np.int64), errors=curve[:, 1], errors_sd=np.full(len(curve), np.nan),
        measure="minus the logarithm of the tracks' probability and a price of the shapes, a coordinate",
    )  # fmt: skip


def from_perspective(found: PerspectiveShapes, camera: Camera) -> RecoveredShapes:
    """Take over what one camera of known intrinsics told.

    Args:
        found: The answer.
        camera: Whose tracks they were, standing at the origin; it says where the points appear.
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
    """Take over what calibrated cameras told; lengths are metres, residuals pixels."""
    modelled = np.stack([np.moveaxis(camera.project(found.points), 1, 2) for camera in rig])
    return RecoveredShapes(
        kind=CALIBRATED, shape=found.shape, shape_sd=found.shape_sd, rotation=found.rotation,
        rotation_sd=found.rotation_sd, translation=found.translation, basis=found.basis,
        coefficients=found.coefficients, residuals=found.residuals_px, predicted=found.predicted & (found.views == 0),
        modelled=modelled, noise_sd=np.full(len(rig), found.noise_px), gauge=GAUGES[CALIBRATED], notes=found.notes,
        curve=_curve_of(found, "distance of pixels held back from what the others foretell, RMS [px]"),
        unit="m", residual_unit="px", metres_per_unit=1.0,
    )  # fmt: skip


def from_many_views(found: ManyViewShapes) -> RecoveredShapes:
    """Take over what several uncalibrated cameras told."""
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
    """Take over what several uncalibrated cameras told of a thing that comes and goes, but keeps its size."""
    plain, size = from_many_views(found.shapes), found.magnification
    assert plain.cameras is not None
    translation = found.shapes.translation * size[:, None]
    cameras = replace(plain.cameras, translation=translation, magnification=size)
    notes = plain.notes
    if np.ptp(size) > 0:
        notes = (*notes, HELD.format(least=size.min(), most=size.max()))
    return replace(
        plain, modelled=plain.modelled * size[:, None, None], residuals=plain.residuals * size[:, None],
        translation=translation[0], cameras=cameras, notes=notes,
    )  # fmt: skip


def from_scaled(found: ScaledShapes) -> RecoveredShapes:
    """Take over what one camera told of a thing that comes and goes, but keeps its size."""
    plain, size = from_one_view(found.in_tracks_unit), found.magnification
    turned = (plain.rotation @ plain.shape)[:, :2] * size[:, None, None]
    relations = CameraRelations(
        camera_from_first=np.eye(3)[None], camera_sd=np.zeros((1, 3)), scale=np.ones(1),
        translation=plain.translation[None], magnification=size,
    )  # fmt: skip
    return replace(
        plain, kind=SCALED_VIEW, modelled=(turned + plain.translation[..., None])[None], cameras=relations,
        gauge=GAUGES[SCALED_VIEW], notes=(*plain.notes, HELD.format(least=size.min(), most=size.max())),
    )  # fmt: skip


def from_points(found: HomogeneousShapes) -> RecoveredShapes:
    """Take over what points in space told."""
    frames, _, points = found.shape.shape
    curve = _curve_of(found, "distance of points held back from what the others foretell, RMS")
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


def usable(seen: Mask, *, least_points: int, least_frames: int) -> tuple[Mask, Mask]:
    """Find the frames and points that hold enough, leaving out what holds too little until nothing changes.

    Args:
        seen: (C, F, P) by camera.
        least_points: That one camera at least must see of a frame.
        least_frames: In which a point must be seen.

    Returns:
        Which frames (F,) and which points (P,) are kept.

    Raises:
        MareyError: None is left.
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
            f"{count} points over {shown} frames hold too little: at least {least_points} points must be seen together "
            f"in at least {least_frames} frames."
        )
    return frames, points


def widened(found: RecoveredShapes, frames: Mask, points: Mask) -> RecoveredShapes:
    """Put an answer for some frames and points back among all of them; the others have none.

    Args:
        found: For the frames and points that were kept.
        frames: (F,) which they are.
        points: (P,).
    """
    if frames.all() and points.all():
        return found

    def wide(values: np.ndarray, *kept: Mask | None) -> np.ndarray:
        """Widen the axes for which a mask is given."""
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
    doubt = None if found.path_doubt is None else wide(found.path_doubt, frames, None)
    return replace(
        found, cameras=cameras, path_doubt=doubt, shape=wide(found.shape, frames, None, points),
        shape_sd=wide(found.shape_sd, frames, None, points),
        rotation=wide(found.rotation, frames, None, None), rotation_sd=wide(found.rotation_sd, frames, None),
        translation=wide(found.translation, frames, None), basis=wide(found.basis, None, None, points),
        coefficients=wide(found.coefficients, frames, None), residuals=wide(found.residuals, None, frames, points),
        predicted=wide(found.predicted, frames, points), modelled=wide(found.modelled, None, frames, None, points),
    )  # fmt: skip


def known_distance(found: RecoveredShapes, first: int, second: int, metres: float) -> RecoveredShapes:
    """Give the shapes a scale, from the distance between two points that is known.

    The median over the frames decides: the two may move against each other, and depth is noisy.

    Args:
        found: The shapes.
        first: A point, counted from 0.
        second: Another one.
        metres: How far they are apart.

    Raises:
        MareyError: The points are no two different ones with an answer, or the distance is no length.
    """
    count = found.shape.shape[2]
    if not (np.isfinite(metres) and metres > 0):
        raise MareyError(f"The known distance is {metres:g} m; it should be more than 0.")
    if first == second or not (0 <= first < count and 0 <= second < count):
        raise MareyError(
            f"The known distance is between the points {first} and {second}; they should be two different ones of 0 to "
            f"{count - 1}."
        )
    apart = np.linalg.norm(found.shape[:, :, first] - found.shape[:, :, second], axis=1)
    apart = apart[np.isfinite(apart)]
    middle = float(np.median(apart)) if len(apart) else 0.0
    if not middle > 0:
        raise MareyError(f"The points {first} and {second} have no distance here: nothing tells where both are.")
    spread = float(np.std(apart)) / middle
    note = (
        f"Scale: the points {first} and {second} are {metres:g} m apart as you say; their distance varies by "
        f"{100 * spread:.1f} % over the frames, and the median counts."
    )
    return replace(
        found, metres_per_unit=metres / middle, metres_per_unit_sd=spread * metres / middle,
        gauge=tuple(line for line in found.gauge if not line.startswith("Scale:")) + (note,),
    )  # fmt: skip
