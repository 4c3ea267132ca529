"""Joints as soft constraints between bones: their laxity, and linear equations with standard deviations."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.geometry import rotations
from marey.motion.anatomical import euler_angles


def krige(to_known: Floats, among_known: Floats) -> tuple[Floats, Floats]:
    """Give the weights with which known values are averaged, and the variance of the result ([Matheron1963]).

    Ordinary kriging: the field's mean is unknown, the weights of a frame sum to one, and a known frame gets itself
    back. Frames known twice share their weight.

    Args:
        to_known: (F, K) semivariance between each frame and each known one: half the variance of what differs.
        among_known: (K, K) the same among the known ones.

    Returns:
        Weights (F, K) and variance (F,) in the semivariance's unit.
    """
    known = len(among_known)
    system = np.ones((known + 1, known + 1))
    system[:known, :known] = among_known
    system[known, known] = 0.0
    right = np.concatenate([to_known, np.ones((len(to_known), 1))], 1)
    solved = right @ np.linalg.pinv(system, hermitian=True)
    return solved[:, :known], np.maximum((solved * right).sum(1), 0.0)


_SAME_POSTURE_S = 0.15
_SAME_POSTURE_TURN = np.radians(20)
_FAR_TURN = np.radians(45)
_SIDES = ("left_", "right_")
_ALSO_CALLED = {"femur": "thigh", "tibia": "shank", "humerus": "upperarm", "ulna": "forearm", "calcaneus": "foot"}


@dataclass(frozen=True, kw_only=True)
class Give:
    """How far a small motion of a joint lies apart at two instants."""

    anyway: float
    """Standard deviation between two instants of one posture, more than about 0.15 s apart [rad or m]."""
    turned: float
    """Further standard deviation between two postures that the joint's main turn sets 45 degrees apart."""

    def semivariance(self, turn: Floats, time: Floats) -> Floats:
        """Give half the variance of the difference between instants so far apart.

        Args:
            turn: (...) by how much the joint's main turn differs [rad].
            time: (...) by how much the time differs [s].
        """
        apart = 1 - np.exp(-np.abs(time) / _SAME_POSTURE_S - np.abs(turn) / _SAME_POSTURE_TURN)
        return np.asarray((self.anyway**2 * apart + self.turned**2 * np.abs(turn) / _FAR_TURN) / 2)


@dataclass(frozen=True, kw_only=True)
class Laxity:
    """The small motions of a joint whose bones have anatomical frames: X forward, Y up, Z to the right ([Wu2002])."""

    translation: Give
    """Of the joint's centre, along each axis [m]."""
    adduction: Give | None = None
    """The turn about the floating axis, X [rad]; None where it is free."""
    rotation: Give | None = None
    """The turn about the child's long axis, Y [rad]; None where it is free."""


def _degrees(anyway: float, turned: float) -> Give:
    return Give(anyway=np.radians(anyway), turned=np.radians(turned))


def _millimetres(anyway: float, turned: float) -> Give:
    return Give(anyway=anyway / 1000, turned=turned / 1000)


_LAXITY = {
    # Knees with known bones: over a trial adduction ranges over 4 to 11, rotation over 5 to 24 degrees, the centre
    # keeps its place within 1 to 3 mm ([Cereatti2017]). These and all below allow for about twice as much, so that a
    # joint that moves more than most is not drawn to the others.
    ("thigh", "shank"): Laxity(
        adduction=_degrees(3.5, 3.5), rotation=_degrees(5.0, 6.5), translation=_millimetres(4.0, 5.0)
    ),
    ("pelvis", "thigh"): Laxity(translation=_millimetres(2.0, 2.0)),
    ("shank", "foot"): Laxity(translation=_millimetres(6.0, 6.0)),
    ("upperarm", "forearm"): Laxity(adduction=_degrees(3.5, 3.5), translation=_millimetres(4.0, 5.0)),
    ("scapula", "upperarm"): Laxity(translation=_millimetres(5.0, 5.0)),
    ("thorax", "upperarm"): Laxity(translation=_millimetres(10.0, 20.0)),
}
_ANY_OTHER = Laxity(translation=_millimetres(10.0, 10.0))


def laxity(parent: str, child: str) -> Laxity:
    """Give what is known beforehand of the joint between two segments, by their names; of others, next to nothing."""
    return _LAXITY.get((_plain(parent), _plain(child)), _ANY_OTHER)


def _plain(segment: str) -> str:
    for side in _SIDES:
        segment = segment.removeprefix(side)
    return _ALSO_CALLED.get(segment, segment)


_BETWEEN_CLUSTERS = 0.53  # of the way from the child's cluster to the parent's, where a joint's centre is looked for
_CENTRE_SD = 0.08
_CLOSED_SD = 0.0015  # m; how near the two bones' centres lie in a known posture
_INDEPENDENT_FRAMES = 5  # as many frames' worth of centre a whole trial gives: skin errs alike in all its frames
_TILT = np.radians(45)
_TURN_WITH_AXIS = np.radians(20)


@dataclass(frozen=True, eq=False, kw_only=True)
class Bed:
    """One bone's pose as its cluster gives it, and what is believed of the cluster's common motion over the bone.

    The motion is six numbers a frame: a turn about the cluster's centre and a shift, both along the bone's axes.
    """

    rotation: Floats
    """(F, 3, 3) laboratory from bone; NaN without an answer."""
    origin: Floats
    """(F, 3) [m]."""
    centre: Floats
    """(3,) the cluster's centre in the bone's frame [m]."""
    prior: Floats
    """(F, 6, 6) covariance of turn [rad] and shift [m]."""

    def moved(self, step: Floats) -> tuple[Floats, Floats]:
        """Give rotation (F, 3, 3) and origin (F, 3) of the bone, its cluster's motion (F, 6) taken away."""
        rotation = self.rotation @ rotations.exp(step[:, :3])
        middle = self.origin + np.einsum("fij,fj->fi", self.rotation, self.centre + step[:, 3:])
        return rotation, middle - rotation @ self.centre


@dataclass(frozen=True, eq=False, kw_only=True)
class KnownJoint:
    """A joint between two beds, and what is known of it beforehand."""

    parent: int
    """Index among the beds."""
    child: int
    laxity: Laxity
    frames: Integers
    """(K,) of the known postures."""
    parent_pose: tuple[Floats, Floats]
    """Rotation (K, 3, 3) and origin (K, 3) of the parent in the known postures."""
    child_pose: tuple[Floats, Floats]
    turn: Floats
    """(F,) the joint's main turn [rad], finite."""
    time: Floats
    """(F,) [s]."""
    anatomical: bool
    """True where the bones' axes are those that the angles are meant about."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Rows:
    """Linear rows on the motions of the two clusters: residual - wrt @ (change of both) has the covariance sd^2."""

    wrt: Floats
    """(F, R, 12) by the parent's six and the child's six."""
    residual: Floats
    """(F, R)."""
    sd: Floats
    """(F, R)."""


def joint_rows(joint: KnownJoint, beds: list[Bed], steps: Floats, centres: tuple[Floats, Floats]) -> Rows:
    """Gather what a joint says of turn and shift of its two clusters.

    Args:
        joint: The joint.
        beds: S beds.
        steps: (F, S, 6) where the rows are linearised.
        centres: The joint's centre (3,) in the parent and in the child [m].
    """
    parent, child = beds[joint.parent].moved(steps[:, joint.parent]), beds[joint.child].moved(steps[:, joint.child])
    parts = [_centre_rows(joint, beds, parent, child, centres)]
    if joint.anatomical:
        parts += _angle_rows(joint, parent[0], child[0])
    known: Mask = np.asarray(np.isfinite(parent[0]).all((1, 2)) & np.isfinite(child[0]).all((1, 2)))
    return Rows(
        wrt=np.where(known[:, None, None], np.concatenate([part.wrt for part in parts], 1), 0.0),
        residual=np.where(known[:, None], np.concatenate([part.residual for part in parts], 1), 0.0),
        sd=np.concatenate([part.sd for part in parts], 1),
    )


def first_centres(joint: KnownJoint, beds: list[Bed]) -> tuple[Floats, Floats]:
    """Guess a joint's centre (3,) in the parent and in the child: between the clusters in the first known posture."""
    parent, child = _known(joint, 0)
    ends = [pose[1] + pose[0] @ beds[k].centre for pose, k in ((parent, joint.parent), (child, joint.child))]
    middle = _BETWEEN_CLUSTERS * ends[0] + (1 - _BETWEEN_CLUSTERS) * ends[1]
    return parent[0].T @ (middle - parent[1]), child[0].T @ (middle - child[1])


def better_centres(
    joint: KnownJoint, beds: list[Bed], steps: Floats, centres: tuple[Floats, Floats], guess: Floats
) -> tuple[Floats, Floats]:
    """Find a joint's centre by one step of weighted least squares, the clusters' own motions taken out of it.

    Args:
        joint: The joint.
        beds: S beds.
        steps: (F, S, 6) the clusters' motions as known so far.
        centres: In the parent and in the child (3,) as known so far [m].
        guess: (3,) where it is expected in the parent [m].
    """
    parent, child = beds[joint.parent].moved(steps[:, joint.parent]), beds[joint.child].moved(steps[:, joint.child])
    base = np.swapaxes(beds[joint.parent].rotation, 1, 2)
    gap = _gap(base, parent, child, centres)
    wrt = _gap_wrt(joint, beds, base, parent, child, centres)
    step = np.concatenate([steps[:, joint.parent], steps[:, joint.child]], 1)
    at_rest = gap - np.einsum("frk,fk->fr", wrt, step)
    scatter = wrt @ _both_priors(joint, beds) @ np.swapaxes(wrt, 1, 2) + _centre_variance(joint) * np.eye(3)
    by_centres = np.concatenate([-base @ parent[0], base @ child[0]], 2)
    normal, right = _normal(by_centres, scatter, at_rest, np.asarray(np.isfinite(gap).all(1)))
    normal[:3, :3] += np.eye(3) / _CENTRE_SD**2
    right[:3] += (guess - centres[0]) / _CENTRE_SD**2
    for posture in range(len(joint.frames)):
        p, c = _known(joint, posture)
        closed = np.concatenate([-p[0], c[0]], 1)
        apart = c[0] @ centres[1] + c[1] - p[0] @ centres[0] - p[1]
        normal += closed.T @ closed / _CLOSED_SD**2
        right -= closed.T @ apart / _CLOSED_SD**2
    change = np.linalg.solve(normal, right)
    return centres[0] + change[:3], centres[1] + change[3:]


def is_anatomical(relative: Floats) -> bool:
    """Tell whether a joint turns mainly about Z in both of its bones; one that hardly turns is believed to.

    Args:
        relative: (F, 3, 3) parent from child; NaN where unknown.
    """
    known = relative[np.isfinite(relative).all((1, 2))]
    if len(known) < 2:
        return True
    in_child = rotations.log(known[0].T @ known)
    if np.linalg.norm(in_child, axis=-1).max() < _TURN_WITH_AXIS:
        return True
    axis = np.linalg.eigh(in_child.T @ in_child)[1][:, 2]
    return bool(min(abs(axis[2]), abs((known[0] @ axis)[2])) > np.cos(_TILT))


def _known(joint: KnownJoint, posture: int) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
    parent, child = joint.parent_pose, joint.child_pose
    return (parent[0][posture], parent[1][posture]), (child[0][posture], child[1][posture])


def _centre_rows(
    joint: KnownJoint, beds: list[Bed], parent: tuple[Floats, Floats], child: tuple[Floats, Floats],
    centres: tuple[Floats, Floats],
) -> Rows:  # fmt: skip
    base = np.swapaxes(beds[joint.parent].rotation, 1, 2)
    gap = _gap(base, parent, child, centres)
    known = _gap(np.swapaxes(joint.parent_pose[0], 1, 2), joint.parent_pose, joint.child_pose, centres)
    weights, variance = _krige(joint, "translation")
    wrt = _gap_wrt(joint, beds, base, parent, child, centres)
    sd = np.repeat(np.sqrt(variance)[:, None], 3, 1)
    return Rows(wrt=wrt, residual=weights @ known - gap, sd=sd)


def _angle_rows(joint: KnownJoint, parent: Floats, child: Floats) -> list[Rows]:
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
        rows.append(Rows(wrt=row, residual=residual[:, None], sd=np.sqrt(variance)[:, None]))
    return rows


def angles_wrt_turns(relative: Floats, angles: Floats) -> Floats:
    """Differentiate the three angles Z-X-Y by small turns of parent and child about their own axes.

    Args:
        relative: (F, 3, 3) parent from child.
        angles: (F, 3) flexion, adduction, rotation [rad].

    Returns:
        (F, 3, 6).
    """
    cos, sin = np.cos(angles[:, 2]), np.sin(angles[:, 2])
    axes = np.zeros_like(relative)
    # The three axes as the child sees them: the parent's Z, the floating X, its own Y.
    axes[:, :, 0] = relative[:, 2]
    axes[:, 0, 1], axes[:, 2, 1] = cos, sin
    axes[:, 1, 2] = 1.0
    by_child = np.full_like(axes, np.nan)
    known = np.isfinite(relative).all((1, 2))
    by_child[known] = np.linalg.pinv(axes[known])
    return np.concatenate([-by_child @ np.swapaxes(relative, 1, 2), by_child], 2)


def _krige(joint: KnownJoint, name: str) -> tuple[Floats, Floats]:
    """Give weights (F, K) of the known postures for one small motion, and its variance (F,)."""
    give = getattr(joint.laxity, name)
    turn, time = joint.turn, joint.time
    half = give.semivariance(turn[:, None] - turn[joint.frames], time[:, None] - time[joint.frames])
    return krige(half, half[joint.frames])


def _centre_variance(joint: KnownJoint) -> float:
    give = joint.laxity.translation
    return give.anyway**2 + give.turned**2


def _gap(
    base: Floats, parent: tuple[Floats, Floats], child: tuple[Floats, Floats], centres: tuple[Floats, Floats]
) -> Floats:
    """Give (F, 3) from the parent's centre to the child's, along the parent's axes as its cluster gives them [m]."""
    apart = child[0] @ centres[1] + child[1] - parent[0] @ centres[0] - parent[1]
    return np.asarray((base @ apart[..., None])[..., 0])


def _gap_wrt(
    joint: KnownJoint, beds: list[Bed], base: Floats, parent: tuple[Floats, Floats], child: tuple[Floats, Floats],
    centres: tuple[Floats, Floats],
) -> Floats:  # fmt: skip
    """Differentiate the gap by the clusters' motions (F, 3, 12)."""
    wrt = np.zeros((len(base), 3, 12))
    wrt[:, :, 0:3] = base @ parent[0] @ rotations.hat(centres[0] - beds[joint.parent].centre)
    wrt[:, :, 3:6] = -np.eye(3)
    wrt[:, :, 6:9] = -base @ child[0] @ rotations.hat(centres[1] - beds[joint.child].centre)
    wrt[:, :, 9:12] = base @ beds[joint.child].rotation
    return wrt


def _both_priors(joint: KnownJoint, beds: list[Bed]) -> Floats:
    both = np.zeros((len(joint.time), 12, 12))
    both[:, :6, :6], both[:, 6:, 6:] = beds[joint.parent].prior, beds[joint.child].prior
    return both


def _normal(wrt: Floats, scatter: Floats, value: Floats, known: Mask) -> tuple[Floats, Floats]:
    """Sum the normal equations (6, 6) and (6,) of frames that count together as a few independent ones."""
    share = min(1.0, _INDEPENDENT_FRAMES / max(int(known.sum()), 1))
    weight = np.linalg.inv(scatter[known])
    normal = share * np.einsum("fij,fik,fkl->jl", wrt[known], weight, wrt[known])
    return normal, -share * np.einsum("fij,fik,fk->j", wrt[known], weight, value[known])
