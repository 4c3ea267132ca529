"""Whether a trial supports the prior laxity of its joints: a knee that rotates more than usual is held less."""

import numpy as np

from marey.arrays import Floats, Mask
from marey.markers.methods.joint_constraints import ClusterPose, ConstraintRows, KnownJoint

_TRANSLATIONS = 3
"""Number of the first equations of a joint, which are those of its centre; their standard deviations are kept."""
_LOG_FACTORS = np.linspace(0.0, np.log(30.0), 61)
"""Logarithms of the factors of a variance that are compared; steps of 6 %."""
_LOG_FACTOR_SD = np.log(4.0)
"""Prior standard deviation of the logarithm of a factor. Chosen by hand."""


def laxity_factors(joint: KnownJoint, clusters: list[ClusterPose], rows: ConstraintRows) -> Floats:
    """Estimate by how much the variances of a joint's small rotations exceed the prior ones, at least 1.

    Ours: without a correction of the clusters, the deviations of a small rotation from its reference have the variance
    of the skin's common motion plus that of the joint. If they are larger than both explain, the joint of this person
    or of this activity rotates more than usual: with the usual variance, its true rotation would be removed as skin
    motion. The factor of the joint's variance is the most probable one under a normal prior of its logarithm. The
    frames have the weight of a few independent ones, because both motions are correlated between frames.

    Args:
        joint: The joint.
        clusters: S clusters with the prior of their common motions.
        rows: The joint's equations at common motions of zero.

    Returns:
        (R,) one factor per equation; 1 for those of the joint's centre.
    """
    factors = np.ones(rows.sd.shape[1])
    known: Mask = np.array(np.isfinite(clusters[joint.parent].origin).all(1))
    known &= np.isfinite(clusters[joint.child].origin).all(1)
    known[joint.frames] = False
    if not known.any():
        return factors
    prior = np.zeros((int(known.sum()), 12, 12))
    prior[:, :6, :6], prior[:, 6:, 6:] = clusters[joint.parent].prior[known], clusters[joint.child].prior[known]
    skin = np.einsum("fri,fij,frj->fr", rows.wrt[known], prior, rows.wrt[known])
    for k in range(_TRANSLATIONS, len(factors)):
        variance = skin[:, k] + np.exp(_LOG_FACTORS)[:, None] * rows.sd[known, k] ** 2
        misfit = np.mean(np.log(variance) + rows.residual[known, k] ** 2 / variance, axis=1)
        cost = joint.settings.independent_frames * misfit + (_LOG_FACTORS / _LOG_FACTOR_SD) ** 2
        factors[k] = np.exp(_LOG_FACTORS[int(np.argmin(cost))])
    return factors
