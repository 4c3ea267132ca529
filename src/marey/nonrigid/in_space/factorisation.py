"""Shape and motion of a deforming set of points in space: the homogeneous factorisation, solved by least squares.

The points of frame t are T_t (S_1 + c_t2 S_2 + ... + c_tK S_K) ([Alexander2003] eq. (15)-(18)), T_t a rigid motion.
Unlike the paper, which takes T and the weights from singular vectors and mends them with one corrective matrix,
everything is solved for together: poses by Gauss-Newton on the manifold of rigid motions, basis shapes point by
point, missing points left out, the weights held by their own spread. Homogeneous coordinates (the fourth row of a
shape is 1) say that the weights of the mean shape are 1; S_2 ... S_K are displacements and their fourth row is 0.

The factorisation leaves a choice ("gauge"): a motion and a displacement that looks like it cannot be told apart. Here
displacements carry no motion of the mean shape: neither a translation nor, to first order, a rotation. So T_t is the
motion from which the points depart least, and no more than that is known about the bone beneath. (Left free, the
motions of real skin wander by tens of degrees for a hundredth of the residual.)
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.errors import MareyError
from marey.nonrigid.in_space.errors import shape_covariance
from marey.nonrigid.in_space.measured_places import MeasuredPlaces, PointsInSpace
from marey.nonrigid.in_space.model import HomogeneousModel, improve, with_more_modes
from marey.nonrigid.in_space.rank import RankChoice, choose_rank_of
from marey.nonrigid.in_space.start import most_shapes, start

RIGID = "The object is rigid as far as these points tell: its mean shape alone explains them."
UNSOLVED = "{} of {} frames have fewer than three points off one line, and no answer."
UNTIED = "{} of {} points are never measured together with the rest, and have no answer."


@dataclass(frozen=True, eq=False, kw_only=True)
class HomogeneousShapes:
    """The shapes and rigid motions of P points over F frames; NaN where there is no answer.

    The object's frame lies at the centre of the mean shape; its axes are those of the laboratory in frame `reference`.
    """

    shape: Floats
    """(F, 3, P) in the object's frame, in the unit of the points; also of points that were missing (`predicted`)."""
    shape_sd: Floats
    """(F, 3, P) standard deviation of the shape."""
    rotation: Floats
    """(F, 3, 3) laboratory from object."""
    translation: Floats
    """(F, 3) the object's origin in the laboratory."""
    covariance: Floats
    """(F, 6, 6) of the turn about the object's axes, exp(turn) to the right of the rotation [rad], and of the
    translation; from the noise about the model alone, not from what all points do together and the bone does not. The
    object's axes are taken as known: an error of the reference's own pose turns all frames alike."""
    basis: Floats
    """(K, 3, P) the mean shape, and displacements of root mean square 1 a point, uncorrelated, the largest first."""
    coefficients: Floats
    """(F, K) the weights; the first is 1, the others are in the unit of the points."""
    noise_sd: float
    """Standard deviation of a coordinate about the model."""
    residuals: Floats
    """(F, P) distance of each measured point from the model; NaN where missing."""
    predicted: Mask
    """(F, P) true where the shape of a missing point is given."""
    reference: int
    """The frame in which the object's axes are those of the laboratory."""
    choice: RankChoice | None
    """How the number of basis shapes was chosen; None where it was given."""
    notes: tuple[str, ...]
    """What a user should know of this answer."""

    def __post_init__(self) -> None:
        names = ("shape", "shape_sd", "rotation", "translation", "covariance", "basis", "coefficients", "residuals")
        freeze_fields(self, *names)
        freeze_fields(self, "predicted", dtype=bool)

    @property
    def rank(self) -> int:
        """K, the number of basis shapes with the mean."""
        return len(self.basis)

    @property
    def homogeneous_basis(self) -> Floats:
        """(K, 4, P) the basis shapes with their fourth row ([Alexander2003] eq. (15)): 1 in the mean, else 0."""
        fourth = np.zeros((self.rank, 1, self.basis.shape[2]))
        fourth[0] = 1
        return np.concatenate([self.basis, fourth], 1)

    @property
    def points(self) -> Floats:
        """(F, P, 3) the model's points in the laboratory."""
        return np.asarray(np.einsum("fij,fjp->fpi", self.rotation, self.shape) + self.translation[:, None])

    @property
    def rotation_sd(self) -> Floats:
        """(F, 3) standard deviation of the turn about the object's axes [rad]."""
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


def factorise_points(points: Floats, rank: int | None = None, *, reference: int | None = None) -> HomogeneousShapes:
    """Find basis shapes, weights and rigid motions of points in space ([Alexander2003] eq. (15)-(21)).

    Args:
        points: (F, P, 3) in any unit; NaN where a point is missing.
        rank: K, the number of basis shapes with the mean; 1 is the rigid fit to the mean shape, None chooses it by
            points held back.
        reference: the frame in which the object's axes are those of the laboratory; by default the first with a pose.

    Returns:
        The shapes; NaN in frames with fewer than three points, and for points never measured together with the rest.

    Raises:
        MareyError: The rank does not suit the numbers of frames and points, too little is measured, or the
            reference has no pose.
    """
    points = np.asarray(points, float)
    if points.ndim != 3 or points.shape[2] != 3:
        raise MareyError(f"Points have the shape {points.shape} and should have (frames, points, 3).")
    return HomogeneousShapes(**solved_shapes(PointsInSpace(points), rank, reference)[1])


def solved_shapes(
    places: MeasuredPlaces, rank: int | None, reference: int | None
) -> tuple[HomogeneousModel, dict[str, Any]]:
    """Solve the factorisation of places, however they are measured.

    Args:
        places: What is measured.
        rank: K; None chooses it.
        reference: see `factorise_points`.

    Returns:
        The model of the frames and points with an answer, and the fields of `HomogeneousShapes`.

    Raises:
        MareyError: as `factorise_points`.
    """
    if rank is not None and rank < 1:
        raise MareyError(f"The number of basis shapes is {rank} and should be at least 1.")
    model, frames, kept = start(places)
    inner = places.among(frames, kept)
    first = int(frames.argmax()) if reference is None else reference
    if not 0 <= first < len(frames) or not frames[first]:
        raise MareyError(f"Frame {first} has fewer than three points off one line; another should be the reference.")
    choice = choose_rank_of(places) if rank is None else None
    count = choice.rank if choice else rank or 1
    _check_rank(inner, count)
    model = with_more_modes(model, inner, count - 1)
    improve(model, inner)
    fields = _spread_out(model, inner, frames, kept, first)
    rigid = choice is not None and count == 1
    notes = (*_gaps(frames, kept), *((RIGID,) if rigid else ()))
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
        raise MareyError(
            f"{rank} basis shapes are too many for {points} points over {frames} frames: "
            f"at most {most_shapes(places)} can be told."
        )


def _gaps(frames: Mask, kept: Mask) -> tuple[str, ...]:
    """Say what has no answer."""
    notes = []
    if not frames.all():
        notes.append(UNSOLVED.format((~frames).sum(), len(frames)))
    if not kept.all():
        notes.append(UNTIED.format((~kept).sum(), len(kept)))
    return tuple(notes)


def _spread_out(
    model: HomogeneousModel, places: MeasuredPlaces, frames: Mask, kept: Mask, reference: int
) -> dict[str, Any]:
    """Spread the answer over all frames and points, in the axes of the reference."""
    total, count, modes = len(frames), len(kept), len(model.modes)
    # object of the answer from object of the model: the laboratory's axes in the reference frame
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
