"""Joints as soft constraints between bones: their laxity, and linear equations with standard deviations."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.geometry import rotations
from marey.geometry.vectors import products
from marey.motion.anatomical import SIDE_PREFIXES, euler_angles


def krige(to_known: Floats, among_known: Floats) -> tuple[Floats, Floats]:
    """Compute the weights of known values in an interpolation, and its variance, by ordinary kriging ([Matheron1963]).

    The mean of the field is unknown, the weights of a frame sum to one, and a known frame is reproduced exactly. Frames
    known twice share their weight.

    Args:
        to_known: (F, K) semivariance between each frame and each known one: half the variance of the difference.
        among_known: (K, K) the same between the known frames.

    Returns:
        Weights (F, K) and variance (F,) in the unit of the semivariance.
    """
    known = len(among_known)
    system = np.ones((known + 1, known + 1))
    system[:known, :known] = among_known
    system[known, known] = 0.0
    right = np.concatenate([to_known, np.ones((len(to_known), 1))], 1)
    solved = right @ np.linalg.pinv(system, hermitian=True)
    return solved[:, :known], np.maximum((solved * right).sum(1), 0.0)


CORRELATION_TIME_S = 0.15
"""Time over which the small motions of a joint, and the wobble of the skin, are correlated [s]. Chosen by hand; results
were not measured against other values."""
CORRELATION_ANGLE = float(np.radians(20))
"""Main rotation over which the small motions of a joint are correlated [rad]. Chosen by hand."""
_REFERENCE_ANGLE = np.radians(45)
"""Main rotation to which `JointVariation.rotation_sd` refers [rad]; a convention."""
_SYNONYMS = {"femur": "thigh", "tibia": "shank", "humerus": "upperarm", "ulna": "forearm", "calcaneus": "foot"}
"""Maps the name of a bone to that of its segment."""


@dataclass(frozen=True, kw_only=True)
class JointVariation:
    """Standard deviations of a small motion of a joint between two instants."""

    baseline_sd: float
    """Standard deviation between two instants of one posture, more than about 0.15 s apart [rad or m]."""
    rotation_sd: float
    """Further standard deviation between two postures 45 degrees of the joint's main rotation apart [rad or m]."""
    growth: float = 1.0
    """Power of the main rotation with which this further variance grows: 1 for a random walk, 2 for a motion that is
    proportional to the main rotation. For the knee, 1 and 2 are compared in docs/accuracy/markers.md."""
    correlation_time_s: float = CORRELATION_TIME_S
    """Time over which the motion is correlated [s]."""
    correlation_angle: float = CORRELATION_ANGLE
    """Main rotation over which the motion is correlated [rad]."""

    def semivariance(self, turn: Floats, time: Floats) -> Floats:
        """Return half the variance of the difference between two instants.

        Args:
            turn: (...) difference of the joint's main rotation [rad].
            time: (...) difference of time [s].

        Returns:
            (...) semivariance [rad2 or m2].
        """
        apart = 1 - np.exp(-np.abs(time) / self.correlation_time_s - np.abs(turn) / self.correlation_angle)
        grown = (np.abs(turn) / _REFERENCE_ANGLE) ** self.growth
        return np.asarray((self.baseline_sd**2 * apart + self.rotation_sd**2 * grown) / 2)


@dataclass(frozen=True, kw_only=True)
class JointLaxity:
    """The small motions of a joint whose bones have anatomical frames: X forward, Y up, Z to the right ([Wu2002])."""

    translation: JointVariation
    """Translation of the joint's centre along each axis [m]."""
    adduction: JointVariation | None = None
    """Rotation about the floating axis, X [rad]; None if it is free."""
    rotation: JointVariation | None = None
    """Rotation about the child's long axis, Y [rad]; None if it is free."""


def _degrees(baseline_sd: float, rotation_sd: float) -> JointVariation:
    return JointVariation(baseline_sd=float(np.radians(baseline_sd)), rotation_sd=float(np.radians(rotation_sd)))


def _millimetres(baseline_sd: float, rotation_sd: float) -> JointVariation:
    return JointVariation(baseline_sd=baseline_sd / 1000, rotation_sd=rotation_sd / 1000)


_LAXITY = {
    ("thigh", "shank"): JointLaxity(
        adduction=_degrees(3.5, 7.0), rotation=_degrees(5.0, 9.0), translation=_millimetres(4.0, 5.0)
    ),
    ("pelvis", "thigh"): JointLaxity(translation=_millimetres(2.0, 2.0)),
    ("shank", "foot"): JointLaxity(translation=_millimetres(6.0, 6.0)),
    ("upperarm", "forearm"): JointLaxity(adduction=_degrees(3.5, 3.5), translation=_millimetres(4.0, 5.0)),
    ("scapula", "upperarm"): JointLaxity(translation=_millimetres(5.0, 5.0)),
    ("thorax", "upperarm"): JointLaxity(translation=_millimetres(10.0, 20.0)),
}
"""Laxity by parent and child segment. Knees with known bones ([Cereatti2017]): over a trial adduction ranges over 4 to
11 degrees, rotation over 5 to 24 degrees, and the centre stays within 1 to 3 mm. The rotations of the knee were chosen
on six of these trials and 48 made ones; docs/accuracy/markers.md has other values, and the choice without each trial.
The centre's values allow for about twice the measured range. The values of the other joints are judgement in the same
manner, without measurement."""
_OTHER_JOINTS = JointLaxity(translation=_millimetres(10.0, 10.0))
"""Laxity of all other pairs of segments. Chosen by hand."""


@dataclass(frozen=True, kw_only=True)
class JointConstraintSettings:
    """Settings of the constraints between the bones of a joint.

    The defaults were chosen by hand unless a field says otherwise; results were not measured against other values.
    """

    laxity: Mapping[tuple[str, str], JointLaxity] = field(default_factory=lambda: dict(_LAXITY))
    """Laxity of the joints by the kinds of parent and child segment. See `_LAXITY` for its sources."""
    other_joints: JointLaxity = _OTHER_JOINTS
    """Laxity of all other pairs of segments."""
    centre_fraction: float = 0.53
    """Initial position of a joint's centre on the way from the child's cluster (0) to the parent's (1)."""
    centre_sd_m: float = 0.08
    """Prior standard deviation of a joint's centre about its initial position [m]."""
    known_gap_sd_m: float = 0.0015
    """Standard deviation of the gap between the two bones' joint centres in a known posture [m]."""
    independent_frames: float = 5.0
    """A trial carries as much information on a joint's centre as this number of frames, because skin errors are
    correlated between frames."""
    largest_tilt: float = float(np.radians(45))
    """A joint whose main axis deviates from Z by more than this [rad] in both bones has no anatomical axes."""
    least_rotation: float = float(np.radians(20))
    """A joint must rotate at least this much [rad] for its main axis to be evaluated."""


JOINT_CONSTRAINT_DEFAULTS = JointConstraintSettings()
"""Default settings of the constraints between the bones of a joint."""
_TRANSLATIONS = 3
"""Number of the first equations of a joint, which are those of its centre; their standard deviations are kept."""
_LEAST_VARIANCE = 1e-12
"""Variance [rad2] of a rotation that is known exactly; numerical."""
_LOG_FACTORS = np.linspace(0.0, np.log(30.0), 61)
"""Logarithms of the factors of a variance that are compared; steps of 6 %."""
_LOG_FACTOR_SD = np.log(4.0)
"""Prior standard deviation of the logarithm of a factor. Chosen by hand."""


def laxity(parent: str, child: str, settings: JointConstraintSettings = JOINT_CONSTRAINT_DEFAULTS) -> JointLaxity:
    """Return the prior laxity of the joint between two segments, by their names; a weak one for unknown joints."""
    return settings.laxity.get((_segment_kind(parent), _segment_kind(child)), settings.other_joints)


def _segment_kind(segment: str) -> str:
    """Return a segment's name without its side, and for a bone the name of its segment."""
    for side in SIDE_PREFIXES:
        segment = segment.removeprefix(side)
    return _SYNONYMS.get(segment, segment)


@dataclass(frozen=True, eq=False, kw_only=True)
class ClusterPose:
    """One bone's pose estimated from its cluster, with the prior of the cluster's common motion over the bone.

    The common motion has six parameters per frame: a rotation about the cluster's centre and a translation, both along
    the bone's axes.
    """

    rotation: Floats
    """(F, 3, 3) laboratory from bone; NaN without an estimate."""
    origin: Floats
    """(F, 3) the bone's origin in the laboratory [m]."""
    centre: Floats
    """(3,) the cluster's centre in the bone's frame [m]."""
    prior: Floats
    """(F, 6, 6) covariance of the common rotation [rad] and translation [m]."""

    def moved(self, step: Floats) -> tuple[Floats, Floats]:
        """Return rotation (F, 3, 3) and origin (F, 3) [m] of the bone after removal of a common motion (F, 6)."""
        rotation = self.rotation @ rotations.exp(step[:, :3])
        middle = self.origin + np.einsum("fij,fj->fi", self.rotation, self.centre + step[:, 3:])
        return rotation, middle - rotation @ self.centre


@dataclass(frozen=True, eq=False, kw_only=True)
class KnownJoint:
    """A joint between two clusters, with its prior knowledge."""

    parent: int
    """Index of the parent among the clusters."""
    child: int
    """Index of the child among the clusters."""
    laxity: JointLaxity
    frames: Integers
    """(K,) frame indices of the known postures."""
    parent_pose: tuple[Floats, Floats]
    """Rotation (K, 3, 3) and origin (K, 3) [m] of the parent in the known postures."""
    child_pose: tuple[Floats, Floats]
    """The same of the child."""
    turn: Floats
    """(F,) the joint's main rotation [rad], finite."""
    time: Floats
    """(F,) time of each frame [s]."""
    anatomical: bool
    """True if the bones' axes are anatomical, so that the angles have their usual meaning."""
    settings: JointConstraintSettings = JOINT_CONSTRAINT_DEFAULTS
    """Settings of its constraints."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ConstraintRows:
    """Linear equations of two clusters' motions: residual - wrt @ (change of both) has standard deviation sd."""

    wrt: Floats
    """(F, R, 12) derivatives by the parent's six and the child's six parameters."""
    residual: Floats
    """(F, R) [rad or m]."""
    sd: Floats
    """(F, R) [rad or m]."""


def joint_rows(
    joint: KnownJoint, clusters: list[ClusterPose], steps: Floats, centres: tuple[Floats, Floats]
) -> ConstraintRows:
    """Linearise a joint's constraints on the common motions of its two clusters.

    Args:
        joint: The joint.
        clusters: S clusters.
        steps: (F, S, 6) common motions at which the constraints are linearised.
        centres: The joint's centre (3,) in the parent and in the child [m].

    Returns:
        The linear equations.
    """
    parent, child = (
        clusters[joint.parent].moved(steps[:, joint.parent]),
        clusters[joint.child].moved(steps[:, joint.child]),
    )
    parts = [_centre_rows(joint, clusters, parent, child, centres)]
    if joint.anatomical:
        parts += _angle_rows(joint, parent[0], child[0])
    known: Mask = np.asarray(np.isfinite(parent[0]).all((1, 2)) & np.isfinite(child[0]).all((1, 2)))
    return ConstraintRows(
        wrt=np.where(known[:, None, None], np.concatenate([part.wrt for part in parts], 1), 0.0),
        residual=np.where(known[:, None], np.concatenate([part.residual for part in parts], 1), 0.0),
        sd=np.concatenate([part.sd for part in parts], 1),
    )


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
    skin = np.einsum("fri,fij,frj->fr", rows.wrt[known], _both_priors(joint, clusters)[known], rows.wrt[known])
    for k in range(_TRANSLATIONS, len(factors)):
        variance = skin[:, k] + np.exp(_LOG_FACTORS)[:, None] * rows.sd[known, k] ** 2 + _LEAST_VARIANCE
        misfit = np.mean(np.log(variance) + rows.residual[known, k] ** 2 / variance, axis=1)
        cost = joint.settings.independent_frames * misfit + (_LOG_FACTORS / _LOG_FACTOR_SD) ** 2
        factors[k] = np.exp(_LOG_FACTORS[int(np.argmin(cost))])
    return factors


def initial_centres(joint: KnownJoint, clusters: list[ClusterPose]) -> tuple[Floats, Floats]:
    """Return a joint's initial centre (3,) in parent and child [m]: between the clusters in the first known posture."""
    parent, child = _known(joint, 0)
    ends = [pose[1] + pose[0] @ clusters[k].centre for pose, k in ((parent, joint.parent), (child, joint.child))]
    fraction = joint.settings.centre_fraction
    middle = fraction * ends[0] + (1 - fraction) * ends[1]
    return parent[0].T @ (middle - parent[1]), child[0].T @ (middle - child[1])


def refined_centres(
    joint: KnownJoint, clusters: list[ClusterPose], steps: Floats, centres: tuple[Floats, Floats], guess: Floats
) -> tuple[Floats, Floats]:
    """Estimate a joint's centre by one step of weighted least squares, with the clusters' common motions marginalised.

    Args:
        joint: The joint.
        clusters: S clusters.
        steps: (F, S, 6) current common motions of the clusters.
        centres: Current centre (3,) in the parent and in the child [m].
        guess: (3,) prior mean in the parent [m].

    Returns:
        The centre (3,) in the parent and in the child [m].
    """
    parent, child = (
        clusters[joint.parent].moved(steps[:, joint.parent]),
        clusters[joint.child].moved(steps[:, joint.child]),
    )
    base = np.swapaxes(clusters[joint.parent].rotation, 1, 2)
    gap = _gap(base, parent, child, centres)
    wrt = _gap_wrt(joint, clusters, base, parent, child, centres)
    step = np.concatenate([steps[:, joint.parent], steps[:, joint.child]], 1)
    at_rest = gap - np.einsum("frk,fk->fr", wrt, step)
    scatter = wrt @ _both_priors(joint, clusters) @ np.swapaxes(wrt, 1, 2) + _centre_variance(joint) * np.eye(3)
    by_centres = np.concatenate([-base @ parent[0], base @ child[0]], 2)
    own = joint.settings
    known: Mask = np.asarray(np.isfinite(gap).all(1))
    normal, right = _normal(by_centres, scatter, at_rest, known, own.independent_frames)
    normal[:3, :3] += np.eye(3) / own.centre_sd_m**2
    right[:3] += (guess - centres[0]) / own.centre_sd_m**2
    for posture in range(len(joint.frames)):
        p, c = _known(joint, posture)
        closed = np.concatenate([-p[0], c[0]], 1)
        apart = c[0] @ centres[1] + c[1] - p[0] @ centres[0] - p[1]
        normal += closed.T @ closed / own.known_gap_sd_m**2
        right -= closed.T @ apart / own.known_gap_sd_m**2
    change = np.linalg.solve(normal, right)
    return centres[0] + change[:3], centres[1] + change[3:]


def is_anatomical(relative: Floats, settings: JointConstraintSettings = JOINT_CONSTRAINT_DEFAULTS) -> bool:
    """Test whether a joint rotates mainly about the Z axes of its bones.

    Args:
        relative: (F, 3, 3) parent from child; NaN where unknown.
        settings: Least rotation, and largest deviation of its axis.

    Returns:
        True if it does, or if it rotates too little, so that the axis cannot be evaluated.
    """
    tilt = axis_tilt(relative, settings)
    return bool(np.isnan(tilt) or tilt < settings.largest_tilt)


def axis_tilt(relative: Floats, settings: JointConstraintSettings = JOINT_CONSTRAINT_DEFAULTS) -> float:
    """Return the angle between the axis about which a joint mainly rotates and the Z axes of its bones.

    Args:
        relative: (F, 3, 3) parent from child; NaN where unknown.
        settings: Least rotation.

    Returns:
        The larger angle of both bones, 0 to pi / 2 [rad]; NaN if the joint rotates too little for an axis.
    """
    known = relative[np.isfinite(relative).all((1, 2))]
    if len(known) < 2:
        return float("nan")
    in_child = rotations.log(known[0].T @ known)
    if np.linalg.norm(in_child, axis=-1).max() < settings.least_rotation:
        return float("nan")
    axis = np.linalg.eigh(in_child.T @ in_child)[1][:, 2]
    return float(np.arccos(min(abs(axis[2]), abs((known[0] @ axis)[2]), 1.0)))


def _known(joint: KnownJoint, posture: int) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
    """Return the poses of parent and child in one known posture."""
    parent, child = joint.parent_pose, joint.child_pose
    return (parent[0][posture], parent[1][posture]), (child[0][posture], child[1][posture])


def _centre_rows(
    joint: KnownJoint, clusters: list[ClusterPose], parent: tuple[Floats, Floats], child: tuple[Floats, Floats],
    centres: tuple[Floats, Floats],
) -> ConstraintRows:  # fmt: skip
    base = np.swapaxes(clusters[joint.parent].rotation, 1, 2)
    gap = _gap(base, parent, child, centres)
    known = _gap(np.swapaxes(joint.parent_pose[0], 1, 2), joint.parent_pose, joint.child_pose, centres)
    weights, variance = _krige(joint, "translation")
    wrt = _gap_wrt(joint, clusters, base, parent, child, centres)
    sd = np.repeat(np.sqrt(variance)[:, None], 3, 1)
    return ConstraintRows(wrt=wrt, residual=weights @ known - gap, sd=sd)


def _angle_rows(joint: KnownJoint, parent: Floats, child: Floats) -> list[ConstraintRows]:
    relative = np.swapaxes(parent, 1, 2) @ child
    angles = euler_angles(relative, "ZXY")
    at_known = euler_angles(np.swapaxes(joint.parent_pose[0], 1, 2) @ joint.child_pose[0], "ZXY")
    wrt = angles_wrt_turns(relative, angles)
    rows = []
    for place, name in ((1, "adduction"), (2, "rotation")):
        if getattr(joint.laxity, name) is None:
            continue
        weights, variance = _krige(joint, name)
        away = weights @ np.unwrap(at_known[:, place]) - angles[:, place]
        row = np.zeros((len(angles), 1, 12))
        row[:, 0, 0:3], row[:, 0, 6:9] = wrt[:, place, :3], wrt[:, place, 3:]
        residual = (away + np.pi) % (2 * np.pi) - np.pi
        rows.append(ConstraintRows(wrt=row, residual=residual[:, None], sd=np.sqrt(variance)[:, None]))
    return rows


def angles_wrt_turns(relative: Floats, angles: Floats) -> Floats:
    """Differentiate the three angles Z-X-Y by small rotations of parent and child about their own axes.

    Args:
        relative: (F, 3, 3) parent from child.
        angles: (F, 3) flexion, adduction, rotation [rad].

    Returns:
        (F, 3, 6).
    """
    cos, sin = np.cos(angles[:, 2]), np.sin(angles[:, 2])
    axes = np.zeros_like(relative)
    # The three axes in the child's frame: the parent's Z, the floating X, its own Y.
    axes[:, :, 0] = relative[:, 2]
    axes[:, 0, 1], axes[:, 2, 1] = cos, sin
    axes[:, 1, 2] = 1.0
    by_child = np.full_like(axes, np.nan)
    known = np.isfinite(relative).all((1, 2))
    by_child[known] = np.linalg.pinv(axes[known])
    return np.concatenate([-by_child @ np.swapaxes(relative, 1, 2), by_child], 2)


def _krige(joint: KnownJoint, name: str) -> tuple[Floats, Floats]:
    """Return the weights (F, K) of the known postures for one small motion, and its variance (F,)."""
    variation = getattr(joint.laxity, name)
    turn, time = joint.turn, joint.time
    half = variation.semivariance(turn[:, None] - turn[joint.frames], time[:, None] - time[joint.frames])
    return krige(half, half[joint.frames])


def _centre_variance(joint: KnownJoint) -> float:
    variation = joint.laxity.translation
    return variation.baseline_sd**2 + variation.rotation_sd**2


def _gap(
    base: Floats, parent: tuple[Floats, Floats], child: tuple[Floats, Floats], centres: tuple[Floats, Floats]
) -> Floats:
    """Return the vector (F, 3) from the parent's centre to the child's, along the parent's axes of its cluster [m]."""
    apart = child[0] @ centres[1] + child[1] - parent[0] @ centres[0] - parent[1]
    return products(base, apart)


def _gap_wrt(
    joint: KnownJoint, clusters: list[ClusterPose], base: Floats, parent: tuple[Floats, Floats], child: tuple[Floats,
    Floats], centres: tuple[Floats, Floats],
) -> Floats:  # fmt: skip
    """Differentiate the gap by the clusters' common motions (F, 3, 12)."""
    wrt = np.zeros((len(base), 3, 12))
    wrt[:, :, 0:3] = base @ parent[0] @ rotations.hat(centres[0] - clusters[joint.parent].centre)
    wrt[:, :, 3:6] = -np.eye(3)
    wrt[:, :, 6:9] = -base @ child[0] @ rotations.hat(centres[1] - clusters[joint.child].centre)
    wrt[:, :, 9:12] = base @ clusters[joint.child].rotation
    return wrt


def _both_priors(joint: KnownJoint, clusters: list[ClusterPose]) -> Floats:
    both = np.zeros((len(joint.time), 12, 12))
    both[:, :6, :6], both[:, 6:, 6:] = clusters[joint.parent].prior, clusters[joint.child].prior
    return both


def _normal(
    wrt: Floats, scatter: Floats, value: Floats, known: Mask, independent_frames: float
) -> tuple[Floats, Floats]:
    """Sum the normal equations (6, 6) and (6,) over frames, weighted as a few independent ones."""
    share = min(1.0, independent_frames / max(int(known.sum()), 1))
    weight = np.linalg.inv(scatter[known])
    normal = share * np.einsum("fij,fik,fkl->jl", wrt[known], weight, wrt[known])
    return normal, -share * np.einsum("fij,fik,fk->j", wrt[known], weight, value[known])
