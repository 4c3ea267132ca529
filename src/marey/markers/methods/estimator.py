"""The method of choice: rigid clusters, soft joints and a statistical model of the skin's motion, together."""

from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Mask
from marey.geometry import rotations
from marey.markers.data.bone_motion import BoneMotion, side_by_side
from marey.markers.data.cluster_data import ClusterData, cluster_data, counted
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.rigid_fit import FEWEST, RigidFit, fit_rigid, one_bone, rigid_bone
from marey.markers.methods.joint_constraints import (
    Bed,
    KnownJoint,
    Rows,
    better_centres,
    first_centres,
    is_anatomical,
    joint_rows,
    krige,
    laxity,
)
from marey.markers.methods.joint_turn import JointTurn, joint_turn, segment_turn
from marey.markers.methods.skin_motion import SkinMotion, filled_postures, learn_skin, settle_sizes, without_gaps

_ROUNDS = 4
_STEPS = 4
_CHUNK = 256
_COMMON_TURN = 0.75  # what all markers do together, as a multiple of what they do against each other;
_COMMON_SHIFT = 1.5  # from three trials with known bones, rounded (docs/marker-methods.md)
_SURPRISING = 5.0  # times the variance expected of a frame's visible motion
_SLENDEREST = 1e-6  # of a cluster's spread, so that markers in a line have some
_FLOOR = 1e-12  # variance that keeps a row finite where both joint and skin are known exactly


@dataclass(frozen=True, eq=False, kw_only=True)
class _Leg:
    """One segment's cluster with what was learned of its skin, and its pose as fitted last."""

    data: ClusterData
    skin: SkinMotion
    fit: RigidFit
    bed: Bed


def skin_and_joints(problem: MarkerProblem) -> BoneMotion:
    """Estimate the bones as the most probable ones under what is believed of skin, joints and noise, with covariance.

    Ours: a cluster shows how far its skin moves unlike a rigid body ([Alexander2003] section 2.6 takes that part to be
    of low rank); the part that is common to all its markers looks like a motion of the bone and cannot be seen. Its
    standard deviation is taken from the visible part. Each cluster's places on the bone are interpolated between the
    known postures by kriging in the joint's turn, the modes' courses and time; what remains unknown is shared between
    the bones of a joint by what the joint is known to give.

    Raises:
        MareyError: The calibration does not fit the trial.
    """
    every = [_placed(cluster_data(problem, cluster)) for cluster in problem.clusters]
    able = [data for data in every if len(data.labels) >= FEWEST]
    rest = [rigid_bone(data, problem.noise_m) for data in every if len(data.labels) < FEWEST]
    if not able:
        return side_by_side(rest)
    found = side_by_side([_together(_narrowed(problem, able), able), *rest])
    order = [found.segments.index(cluster.segment) for cluster in problem.clusters]
    return replace(
        found, segments=tuple(found.segments[k] for k in order), rotation=found.rotation[:, order],
        origin=found.origin[:, order], covariance=found.covariance[:, order],
    )  # fmt: skip


def _placed(data: ClusterData) -> ClusterData:
    """Keep the postures in which the bone is known under enough of the cluster's markers; of none, no marker."""
    known = np.isfinite(data.postures).all(-1).sum(1) >= FEWEST
    kept = data.postures[known]
    seen = np.isfinite(kept).all(-1).any(0) & bool(known.any())
    return replace(
        data, labels=tuple(label for label, there in zip(data.labels, seen, strict=True) if there),
        points=data.points[:, seen], postures=kept[:, seen], frames=data.frames[known],
        rotation=data.rotation[known], origin=data.origin[known],
    )  # fmt: skip


def _narrowed(problem: MarkerProblem, able: list[ClusterData]) -> MarkerProblem:
    """Keep the clusters that can answer, and the joints between them whose bones are known together in some posture."""
    names = {data.segment: set(data.frames.tolist()) for data in able}
    joints = tuple(pair for pair in problem.joints if set(pair) <= set(names) and names[pair[0]] & names[pair[1]])
    clusters = tuple(cluster for cluster in problem.clusters if cluster.segment in names)
    return replace(problem, clusters=clusters, joints=joints, degrees_of_freedom=())


def _together(problem: MarkerProblem, clusters: list[ClusterData]) -> BoneMotion:
    """Estimate the bones of clusters that can answer, in rounds: each knows the joints' turns better than the last."""
    motion = side_by_side([rigid_bone(data, problem.noise_m) for data in clusters])
    skins: tuple[SkinMotion, ...] = ()
    for _ in range(_ROUNDS):
        skins = _skins(problem, clusters, motion, skins)
        legs = [_leg(data, skin, problem.noise_m) for data, skin in zip(clusters, skins, strict=True)]
        joints = [_joint(problem, motion, pair) for pair in problem.joints]
        steps, covariance = _settle([leg.bed for leg in legs], joints)
        motion = _motion(legs, steps, covariance)
    return replace(motion, notes=(*motion.notes, *_notes(skins), *_doubts(problem, joints)))


def _skins(
    problem: MarkerProblem, clusters: list[ClusterData], motion: BoneMotion, before: tuple[SkinMotion, ...]
) -> tuple[SkinMotion, ...]:
    """Learn the skins' motions once, and let them follow the joints' turns as these become known better."""
    turns = []
    for data in clusters:
        found = segment_turn(problem, motion, data.segment)
        turns.append(np.zeros(len(motion)) if found is None else _anchored(found, problem))
    if before:
        return tuple(replace(skin, turn=turn) for skin, turn in zip(before, turns, strict=True))
    time = problem.trajectories.time
    pairs = zip(clusters, turns, strict=True)
    return settle_sizes([learn_skin(data, turn, time, problem.noise_m) for data, turn in pairs])


def _anchored(found: JointTurn, problem: MarkerProblem) -> Floats:
    """Give a turn (F,) without gaps, in the known postures as it truly is."""
    turn = np.array(found.turn)
    known = np.isfinite(found.at_postures)
    turn[problem.calibration.frames[known]] = found.at_postures[known]
    return without_gaps(turn)


def _leg(data: ClusterData, skin: SkinMotion, noise_m: float) -> _Leg:
    """Fit a cluster's shape, interpolated between the known postures, and say how far it may lie off the bone."""
    frames = np.arange(len(data.points))
    weights, variance = krige(skin.semivariance(frames, data.frames), skin.semivariance(data.frames, data.frames))
    places = np.einsum("fk,kmi->fmi", weights, filled_postures(data))
    fit = fit_rigid(places, data.points, noise_m * np.sqrt(2) * skin.looseness)
    reference = places[data.frames[0]]
    variance = variance * _excess(fit, skin, variance, noise_m)
    return _Leg(data=data, skin=skin, fit=fit, bed=Bed(
        rotation=fit.rotation, origin=fit.translation, centre=_centre(reference, skin.looseness),
        prior=_common_motion(reference, skin.size) * variance[:, None, None],
    ))  # fmt: skip


def _excess(fit: RigidFit, skin: SkinMotion, variance: Floats, noise_m: float) -> Floats:
    """Give (F,) by what factor a frame shows more motion than is expected there, as where a marker has gone wild."""
    used: Mask = np.asarray(np.isfinite(fit.residuals).all(-1))
    free = np.maximum(3 * used.sum(1) - 6, 1)
    seen = np.where(used[..., None], np.nan_to_num(fit.residuals) ** 2, 0.0).sum((1, 2)) / free
    expected = skin.size**2 / 3 * variance + 2 * noise_m**2
    return np.asarray(np.maximum(seen / (_SURPRISING * expected), 1.0))


def _centre(places: Floats, looseness: Floats) -> Floats:
    weight = 1 / looseness**2
    return np.asarray(weight @ places / weight.sum())


def _common_motion(places: Floats, size: float) -> Floats:
    """Give the covariance (6, 6) of the skin's common turn [rad] and shift [m] over a bone.

    A common shift is as large as the visible motion by a factor; a common turn moves the markers so far, about each
    axis by their distance from it, so that a thin cluster turns farther.
    """
    about = places - places.mean(0)
    inertia = ((about**2).sum() * (1 + _SLENDEREST) * np.eye(3) - about.T @ about) / len(places)
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = (_COMMON_TURN * size) ** 2 * np.linalg.inv(inertia)
    covariance[3:, 3:] = (_COMMON_SHIFT * size) ** 2 / 3 * np.eye(3)
    return covariance


def _joint(problem: MarkerProblem, motion: BoneMotion, pair: tuple[str, str]) -> KnownJoint:
    calibration, names = problem.calibration, [cluster.segment for cluster in problem.clusters]
    poses = []
    for segment in pair:
        index = calibration.segments.index(segment)
        poses.append((calibration.rotation[:, index], calibration.origin[:, index]))
    known = np.isfinite(poses[0][0]).all((1, 2)) & np.isfinite(poses[1][0]).all((1, 2))
    poses = [(rotation[known], origin[known]) for rotation, origin in poses]
    turn = _anchored(joint_turn(problem, motion, *pair), problem)
    parent, child = motion.bone(pair[0])[0], motion.bone(pair[1])[0]
    return KnownJoint(
        parent=names.index(pair[0]), child=names.index(pair[1]), laxity=laxity(*pair), frames=calibration.frames[known],
        parent_pose=poses[0], child_pose=poses[1], turn=turn, time=problem.trajectories.time,
        anatomical=is_anatomical(np.swapaxes(parent, 1, 2) @ child),
    )  # fmt: skip


def _settle(beds: list[Bed], joints: list[KnownJoint]) -> tuple[Floats, Floats]:
    """Find the clusters' common motions (F, S, 6) by Gauss-Newton, and their covariance (F, S, 6, 6)."""
    frames = len(beds[0].origin)
    steps = np.zeros((frames, len(beds), 6))
    covariance = np.stack([bed.prior for bed in beds], 1)
    guesses = [first_centres(joint, beds) for joint in joints]
    centres = list(guesses)
    for _ in range(_STEPS if joints else 0):
        rows = []
        for k, joint in enumerate(joints):
            centres[k] = better_centres(joint, beds, steps, centres[k], guesses[k][0])
            rows.append(joint_rows(joint, beds, steps, centres[k]))
        wrt, value, variance = _stacked(joints, rows, steps)
        for start in range(0, frames, _CHUNK):
            part = slice(start, start + _CHUNK)
            prior = np.stack([bed.prior[part] for bed in beds], 1)
            steps[part], covariance[part] = _update(prior, wrt[part], value[part], variance[part])
    return steps, covariance


def _stacked(joints: list[KnownJoint], rows: list[Rows], steps: Floats) -> tuple[Floats, Floats, Floats]:
    """Put all joints' rows (F, R, S, 6), values (F, R) at the motions' zero and variances (F, R) together."""
    frames, count = steps.shape[:2]
    wrts, values = [], []
    for joint, row in zip(joints, rows, strict=True):
        wrt = np.zeros((frames, row.wrt.shape[1], count, 6))
        wrt[:, :, joint.parent], wrt[:, :, joint.child] = row.wrt[..., :6], row.wrt[..., 6:]
        wrts.append(wrt)
        values.append(row.residual + np.einsum("frsk,fsk->fr", wrt, steps))
    variance = np.concatenate([row.sd**2 for row in rows], 1) + _FLOOR
    return np.concatenate(wrts, 1), np.concatenate(values, 1), variance


def _update(prior: Floats, wrt: Floats, value: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """Take rows (n, R, S, 6) into account of independent priors (n, S, 6, 6): means and marginal covariances."""
    count, rows, segments = wrt.shape[:3]
    gathered = np.einsum("nskl,nrsl->nskr", prior, wrt)
    scatter = np.einsum("nrsk,nskq->nrq", wrt, gathered)
    scatter[:, np.arange(rows), np.arange(rows)] += variance
    flat = gathered.reshape(count, segments * 6, rows)
    gain = np.swapaxes(np.linalg.solve(scatter, np.swapaxes(flat, 1, 2)), 1, 2).reshape(count, segments, 6, rows)
    return np.einsum("nskr,nr->nsk", gain, value), prior - np.einsum("nskr,nslr->nskl", gain, gathered)


def _motion(legs: list[_Leg], steps: Floats, covariance: Floats) -> BoneMotion:
    """Take the common motions away, and state what is not known of them beside the noise."""
    bones = []
    for index, leg in enumerate(legs):
        rotation, origin = leg.bed.moved(steps[:, index])
        wrt = np.zeros((len(rotation), 6, 6))
        wrt[:, :3, :3] = np.eye(3)
        wrt[:, 3:, :3] = rotation @ rotations.hat(leg.bed.centre)
        wrt[:, 3:, 3:] = rotation
        skin = wrt @ covariance[:, index] @ np.swapaxes(wrt, 1, 2)
        notes = (
            *leg.data.notes,
            *counted(leg.data.segment, leg.fit.few, f"have fewer than {FEWEST} markers and no answer"),
            *counted(leg.data.segment, leg.fit.collinear, "have their markers in a line and no answer"),
        )
        bones.append(one_bone(leg.data.segment, rotation, origin, skin + leg.fit.noise_covariance, notes))
    return side_by_side(bones)


def _notes(skins: tuple[SkinMotion, ...]) -> tuple[str, ...]:
    """Say of each cluster how far its skin was taken to move, and what it was found to follow."""
    notes = []
    for skin in skins:
        if skin.size == 0:
            notes.append(f"{skin.segment}: the cluster stays rigid within its noise; no skin motion is assumed.")
            continue
        form = skin.form
        shares = (
            f"{form.turn:.0%} with the joint's turn, {form.modes:.0%} with {form.rank} modes, {form.wobble:.0%} neither"
        )
        notes.append(f"{skin.segment}: the skin moves by about {1000 * skin.size:.1f} mm; it goes {shares}.")
    return tuple(notes)


def _doubts(problem: MarkerProblem, joints: list[KnownJoint]) -> tuple[str, ...]:
    names = [cluster.segment for cluster in problem.clusters]
    return tuple(
        f"{names[joint.parent]} and {names[joint.child]}: the joint does not turn about the bones' Z axes; "
        "its angles are left free."
        for joint in joints
        if not joint.anatomical and (joint.laxity.adduction or joint.laxity.rotation)
    )
