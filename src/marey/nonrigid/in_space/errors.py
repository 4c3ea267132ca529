"""Uncertainty of the shapes of the homogeneous factorisation: of weights, of the basis, and unmodelled deformation."""

import numpy as np

from marey.arrays import Floats
from marey.geometry import rotations
from marey.nonrigid.in_space.measured_places import MeasuredPlaces, departures
from marey.nonrigid.in_space.model import HomogeneousModel, add_prior, basis_normal, free_share, turned

FEW_PAIRS = 10
"""Number of pairs of frames at which a point's own estimate of the unmodelled deformation has the same weight as that
of all points. Chosen by hand; results were not measured against other values."""


def shape_covariance(model: HomogeneousModel, places: MeasuredPlaces) -> Floats:
    """Compute the covariance (F, P, 3, 3) of the shapes in the object's frame.

    Args:
        model: Fitted model.
        places: Measured points to which it was fitted.
    """
    carried = np.einsum("fmn,npj->fmpj", model.weight_covariance, model.modes, optimize=True)
    of_weights = np.einsum("mpi,fmpj->fpij", model.modes, carried, optimize=True)
    left = unmodelled_variance(model, places)[..., None, None] * np.eye(3)
    return np.asarray(of_weights + _basis_covariance(model, places) + left)


def pose_variance(model: HomogeneousModel) -> Floats:
    """Compute the trace (F, P) of the points' covariance in the laboratory that results from their frame's pose."""
    shapes = model.shapes
    jacobian = np.concatenate([-rotations.hat(shapes), np.broadcast_to(np.eye(3), (*shapes.shape, 3))], -1)
    return np.asarray(((jacobian @ model.pose_covariance[:, None]) * jacobian).sum((2, 3)))


def _basis_covariance(model: HomogeneousModel, places: MeasuredPlaces) -> Floats:
    information, _ = places.equations(model.places, model.variance)
    row = model.row
    square = row[:, :, None] * row[:, None]
    points, count = len(model.mean), row.shape[1]
    normal = basis_normal(model, turned(information, model.rotation), square)
    add_prior(model, normal, count)
    inverse = np.linalg.inv(normal)
    if information.shape[-1] == 1:
        alone = square.reshape(len(row), -1) @ inverse.reshape(points, -1).T
        return np.asarray(alone[..., None, None] * np.eye(3))
    blocks = inverse.reshape(points, count, 3, count, 3).transpose(1, 3, 0, 2, 4).reshape(count**2, -1)
    return np.asarray((square.reshape(len(row), -1) @ blocks).reshape(len(row), points, 3, 3))


def unmodelled_variance(model: HomogeneousModel, places: MeasuredPlaces) -> Floats:
    """Estimate the part of the residuals that is deformation, as a variance (F, P) of each point's coordinates.

    Noise is uncorrelated between frames and deformation is not, so the covariance of residuals with those of the next
    frame is deformation; fast deformation is missed. Points that were not measured did not attract the model, and have
    a larger variance.
    """
    away, _ = departures(places, model.places, model.variance)
    away, seen = away @ model.rotation, places.seen
    both = seen[1:] & seen[:-1]
    shared, pairs = ((away[1:] * away[:-1]).sum(-1) * both).sum(0), both.sum(0)
    usual = shared.sum() / max(pairs.sum(), 1)
    variance = np.clip((shared + FEW_PAIRS * usual) / (3 * (pairs + FEW_PAIRS)), 0, model.variance)
    return np.asarray(np.where(seen, variance, variance / free_share(model, places) ** 2))
