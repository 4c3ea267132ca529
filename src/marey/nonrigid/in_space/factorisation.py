"""Shape and motion of a deforming set of points in space: the homogeneous factorisation, solved by least squares.

The points of frame t are T_t (S_1 + c_t2 S_2 + ... + c_tK S_K) ([Alexander2003] eq. (15)-(18)), T_t a rigid motion.
Unlike the paper, which takes T and the weights from singular vectors and corrects them with one matrix, all unknowns
are solved for together: poses by Gauss-Newton on the manifold of rigid motions, basis shapes point by point, missing
points left out, the weights regularised by their own variance. In homogeneous coordinates (the fourth row of a shape is
1) the weights of the mean shape are 1; S_2 ... S_K are displacements with fourth row 0.

The factorisation has a gauge freedom: a motion is not distinguishable from a displacement that looks like it. Here
displacements carry no motion of the mean shape: neither a translation nor, to first order, a rotation. T_t is thus the
motion from which the points depart least, and contains no more information about an underlying bone. (With a free
gauge, the motions of real skin vary by tens of degrees for one per cent of the residual.)
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.errors import MareyError, SettingProblem
from marey.nonrigid.in_space.errors import shape_covariance
from marey.nonrigid.in_space.measured_places import MeasuredPlaces, PointsInSpace
from marey.nonrigid.in_space.model import HomogeneousModel, HomogeneousModelSettings, refine, with_more_modes
from marey.nonrigid.in_space.rank import RankChoice, RankChoiceSettings, choose_rank
from marey.nonrigid.in_space.start import RigidStartSettings, most_shapes, rigid_start

RIGID_POINTS = "The object is rigid as far as these points show: its mean shape alone explains them."
"""Note of results without deformation modes."""
UNSOLVED_FRAMES = "{} of {} frames have fewer than three points that are not on one line: they have no result."
"""Note of frames without a pose."""
UNCONNECTED_POINTS = "{} of {} points are never measured together with the others: they have no result."
"""Note of points without a position."""


@dataclass(frozen=True, kw_only=True)
class FactorisationSettings:
    """Settings of the homogeneous factorisation."""

    start: RigidStartSettings = field(default_factory=RigidStartSettings)
    """Settings of the rigid initial solution."""
    model: HomogeneousModelSettings = field(default_factory=HomogeneousModelSettings)
    """Settings of the least squares."""
    rank: RankChoiceSettings = field(default_factory=RankChoiceSettings)
    """Settings of the choice of the number of basis shapes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class HomogeneousShapes:
    """Shapes and rigid motions of P points over F frames; NaN where there is no result.

    The origin of the object's frame is the centre of the mean shape; its axes are those of the laboratory in frame
    `reference`.
    """

    shape: Floats
    """(F, 3, P) in the object's frame, in the unit of the points, including missing points (`predicted`)."""
    shape_sd: Floats
    """(F, 3, P) standard deviation of the shape."""
    rotation: Floats
    """(F, 3, 3) laboratory from object."""
    translation: Floats
    """(F, 3) object's origin in the laboratory."""
    covariance: Floats
    """(F, 6, 6) covariance of the rotation about the object's axes, exp(rotation) to the right [rad], and of the
    translation. It results from the noise about the model alone, and excludes motion of all points relative to a bone.
    The object's axes are taken as exact: an error of the reference frame's pose rotates all frames alike."""
    basis: Floats
    """(K, 3, P) mean shape, and uncorrelated modes of root mean square 1 per point, the largest first."""
    coefficients: Floats
    """(F, K) weights of the basis shapes; the first is 1, the others are in the unit of the points."""
    noise_sd: float
    """Standard deviation of a coordinate about the model."""
    residuals: Floats
    """(F, P) distance of each measured point from the model; NaN where missing."""
    predicted: Mask
    """(F, P) true where the shape includes a missing point."""
    reference: int
    """The frame in which the object's axes are those of the laboratory."""
    choice: RankChoice | None
    """Choice of the number of basis shapes; None where it was given."""
    notes: tuple[str, ...]
    """Notes for the user."""

    def __post_init__(self) -> None:
        names = ("shape", "shape_sd", "rotation", "translation", "covariance", "basis", "coefficients", "residuals")
        freeze_fields(self, *names)
        freeze_fields(self, "predicted", dtype=bool)

    @property
    def rank(self) -> int:
        """Number of basis shapes K, including the mean."""
        return len(self.basis)

    @property
    def points(self) -> Floats:
        """(F, P, 3) points of the model in the laboratory."""
        return np.asarray(np.einsum("fij,fjp->fpi", self.rotation, self.shape) + self.translation[:, None])

    @property
    def rotation_sd(self) -> Floats:
        """(F, 3) standard deviation of the rotation about the object's axes [rad]."""
        return np.asarray(np.sqrt(np.einsum("fii->fi", self.covariance[:, :3, :3])))

    @property
    def translation_sd(self) -> Floats:
        """(F, 3) standard deviation of the translation."""
        return np.asarray(np.sqrt(np.einsum("fii->fi", self.covariance[:, 3:, 3:])))

    @property
    def point_rms(self) -> Floats:
        """(P,) root mean square distance of each measured point from the model; NaN for one never measured."""
        seen = np.isfinite(self.residuals)
        total = np.where(seen, self.residuals, 0) ** 2
        return np.asarray(np.where(seen.any(0), np.sqrt(total.sum(0) / np.maximum(seen.sum(0), 1)), np.nan))


def factorise_points(
    points: Floats,
    rank: int | None = None,
    *,
    reference: int | None = None,
    settings: FactorisationSettings = FactorisationSettings(),
) -> HomogeneousShapes:
    """Estimate basis shapes, weights and rigid motions of points in space ([Alexander2003] eq. (15)-(21)).

    Args:
        points: (F, P, 3) in any unit; NaN where a point is missing.
        rank: Number of basis shapes K, including the mean; 1 is the rigid fit to the mean shape. Chosen by
            cross-validation if None.
        reference: Frame in which the object's axes are those of the laboratory; by default the first with a pose.
        settings: Tuned constants of the algorithm.

    Returns:
        The shapes; NaN in frames with fewer than three points, and for points never measured together with the others.

    Raises:
        MareyError: The rank is too large for the numbers of frames and points, there are too few measurements, or the
            reference frame has no pose.
    """
    points = np.asarray(points, float)
    if points.ndim != 3 or points.shape[2] != 3:
        raise MareyError(f"Points have shape {points.shape}; expected (frames, points, 3).")
    return HomogeneousShapes(**solved_shapes(PointsInSpace(points), rank, reference, settings)[1])


def solved_shapes(
    places: MeasuredPlaces,
    rank: int | None,
    reference: int | None,
    settings: FactorisationSettings = FactorisationSettings(),
) -> tuple[HomogeneousModel, dict[str, Any]]:
    """Solve the factorisation for any kind of measurement.

    Args:
        places: Measured points.
        rank: Number of basis shapes K; chosen by cross-validation if None.
        reference: See `factorise_points`.
        settings: Tuned constants of the algorithm.

    Returns:
        The model of the frames and points with an estimate, and the fields of `HomogeneousShapes`.

    Raises:
        MareyError: As `factorise_points`.
    """
    if rank is not None and rank < 1:
        raise SettingProblem(f"The number of basis shapes is {rank}; expected at least 1.")
    model, frames, kept = rigid_start(places, settings.start, settings.model)
    inner = places.among(frames, kept)
    first = int(frames.argmax()) if reference is None else reference
    if not 0 <= first < len(frames) or not frames[first]:
        raise MareyError(
            f"Frame {first} has fewer than three points that are not on one line; choose another reference frame."
        )
    choice = None
    if rank is None:
        choice = choose_rank(places, settings=settings.rank, start=settings.start, model=settings.model)
    count = choice.rank if choice else rank or 1
    _check_rank(inner, count)
    model = with_more_modes(model, inner, count - 1)
    refine(model, inner)
    fields = _expanded(model, inner, frames, kept, first)
    rigid = choice is not None and count == 1
    notes = (*_gaps(frames, kept), *((RIGID_POINTS,) if rigid else ()))
    away = np.linalg.norm(places.known - fields.pop("points"), axis=-1)
    predicted = np.isfinite(fields["shape"][:, 0]) & ~places.seen
    if choice is not None:
        fields["shape_sd"] = np.where(predicted[:, None], choice.farther, 1) * fields["shape_sd"]
    return model, {
        **fields, "residuals": away, "predicted": predicted, "reference": first, "choice": choice, "notes": notes
    }  # fmt: skip


def _check_rank(places: MeasuredPlaces, rank: int) -> None:
    frames, points = places.seen.shape
    if rank > most_shapes(places):
        raise SettingProblem(
            f"{rank} basis shapes are too many for {points} points over {frames} frames: "
            f"at most {most_shapes(places)} can be determined."
        )


def _gaps(frames: Mask, kept: Mask) -> tuple[str, ...]:
    """Compose the notes on frames and points without an estimate."""
    notes = []
    if not frames.all():
        notes.append(UNSOLVED_FRAMES.format((~frames).sum(), len(frames)))
    if not kept.all():
        notes.append(UNCONNECTED_POINTS.format((~kept).sum(), len(kept)))
    return tuple(notes)


def _expanded(
    model: HomogeneousModel, places: MeasuredPlaces, frames: Mask, kept: Mask, reference: int
) -> dict[str, Any]:
    """Expand the solution to all frames and points, in the axes of the reference frame."""
    total, count, modes = len(frames), len(kept), len(model.modes)
    # object of the result from object of the model: the laboratory's axes in the reference frame
    turn = model.rotation[frames[:reference].sum()]
    basis = np.full((modes + 1, 3, count), np.nan)
    basis[:, :, kept] = np.einsum("ij,kpj->kip", turn, np.concatenate([model.mean[None], model.modes]))
    rotation, translation = np.full((total, 3, 3), np.nan), np.full((total, 3), np.nan)
    covariance, coefficients = np.full((total, 6, 6), np.nan), np.full((total, modes + 1), np.nan)
    rotation[frames], translation[frames] = model.rotation @ turn.T, model.translation
    carry = np.zeros((int(frames.sum()), 6, 6))
    carry[:, :3, :3], carry[:, 3:, 3:] = turn, model.rotation
    covariance[frames] = carry @ model.pose_covariance @ np.swapaxes(carry, 1, 2)
    coefficients[frames] = model.row
    shape = np.einsum("fk,kip->fip", coefficients, basis)
    variance = np.full((total, count, 3), np.nan)
    own = np.einsum("ij,fpjk,ik->fpi", turn, shape_covariance(model, places), turn, optimize=True)
    variance[np.ix_(frames, kept)] = own
    points = np.einsum("fij,fjp->fpi", rotation, shape) + translation[:, None]
    return {
        "shape": shape, "shape_sd": np.sqrt(np.swapaxes(variance, 1, 2)), "rotation": rotation,
        "translation": translation, "covariance": covariance, "basis": basis, "coefficients": coefficients,
        "noise_sd": float(np.sqrt(model.variance)), "points": points,
    }  # fmt: skip
