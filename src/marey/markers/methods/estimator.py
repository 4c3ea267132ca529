"""The default method: rigid clusters, soft joint constraints and a statistical model of the skin's motion."""

from dataclasses import dataclass, field, replace

import numpy as np

from marey.arrays import Floats, Mask
from marey.geometry import rotations
from marey.markers.data.bone_motion import BoneMotion, combine_bones
from marey.markers.data.cluster_data import ClusterData, cluster_data, frame_count_note
from marey.markers.data.clusters import MINIMUM_MARKERS
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.rigid_fit import RigidFit, fit_rigid, one_bone, rigid_bone
from marey.markers.methods.joint_constraints import (
    JOINT_CONSTRAINT_DEFAULTS,
    ClusterPose,
    ConstraintRows,
    JointConstraintSettings,
    KnownJoint,
    initial_centres,
    is_anatomical,
    joint_rows,
    krige,
    laxity,
    laxity_factors,
    refined_centres,
)
from marey.markers.methods.joint_turn import JointTurn, joint_turn, segment_turn
from marey.markers.methods.skin_motion import (
    SkinMotion,
    SkinMotionSettings,
    filled_postures,
    learn_skin,
    shrink_sizes,
    without_gaps,
)
from marey.wording import count_of

_CHUNK = 256
"""Frames whose equations are solved at once; it limits memory."""
_MINIMUM_INERTIA_RATIO = 1e-6
"""Inertia added to a cluster as a ratio to its spread, so that collinear markers have a finite rotation; numerical."""
_MINIMUM_VARIANCE = 1e-12
"""Variance [rad2 or m2] added to every equation, for joints and skin that are both known exactly; numerical."""


@dataclass(frozen=True, kw_only=True)
class SkinAndJointsSettings:
    """Settings of the default method."""

    rounds: int = 4
    """Rounds in which the joints' rotations are updated. Chosen by hand."""
    steps: int = 4
    """Gauss-Newton steps of the common motions. Chosen by hand."""
    common_rotation_ratio: float = 0.75
    """Displacement by the rotation common to all markers as a multiple of their relative motion. From three trials with
    known bones, rounded (docs/explanation/markers.md). In six trials, the errors relative to the rigid fit are 0.85
    with 0.55, and 0.84 with 0.75 (the script was not kept)."""
    common_translation_ratio: float = 2.5
    """The same for the translation common to all markers. In six trials with known bones, the 95 % intervals hold 82 to
    99 % with 1.5 and 86 to 100 % with 2.5; the errors relative to the rigid fit are equal within 0.02
    (the script was not kept)."""
    outlier_variance_ratio: float = 5.0
    """A frame is an outlier when its visible motion has more than this multiple of the expected variance. Chosen by
    hand."""
    skin: SkinMotionSettings = field(default_factory=SkinMotionSettings)
    """Settings of the statistical model of the skin's motion."""
    joints: JointConstraintSettings = JOINT_CONSTRAINT_DEFAULTS
    """Settings of the constraints between the bones of a joint."""


_SETTINGS = SkinAndJointsSettings()
"""Default settings of the method."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _FittedCluster:
    """One segment's cluster with the model of its skin's motion, and its current pose."""

    data: ClusterData
    skin: SkinMotion
    fit: RigidFit
    pose: ClusterPose


def skin_and_joints(problem: MarkerProblem, settings: SkinAndJointsSettings = _SETTINGS) -> BoneMotion:
    """Estimate the most probable bones under statistical models of skin, joints and noise, with covariance.

    Ours: a cluster shows the non-rigid part of its skin's motion ([Alexander2003] section 2.6 assumes it to be of low
    rank); the part common to all its markers is indistinguishable from a motion of the bone. Its standard deviation is
    derived from the visible part. Each cluster's positions on the bone are interpolated between the known postures by
    kriging in the joint's rotation, the modes' time courses and time; the remaining error is distributed between the
    bones of a joint according to the joint's laxity.

    Args:
        problem: The trial.
        settings: Settings of the method.

    Returns:
        The bones with their covariance.

    Raises:
        MareyError: The calibration does not match the trial.
    """
    every = [_with_known_postures(cluster_data(problem, cluster)) for cluster in problem.clusters]
    able = [data for data in every if len(data.labels) >= MINIMUM_MARKERS]
    rest = [rigid_bone(data, problem.noise_m) for data in every if len(data.labels) < MINIMUM_MARKERS]
    if not able:
        return combine_bones(rest)
    found = combine_bones([_estimate_jointly(_restricted(problem, able), able, settings), *rest])
    order = [found.segments.index(cluster.segment) for cluster in problem.clusters]
    return replace(
        found, segments=tuple(found.segments[k] for k in order), rotation=found.rotation[:, order],
        origin=found.origin[:, order], covariance=found.covariance[:, order],
    )  # fmt: skip


def _with_known_postures(data: ClusterData) -> ClusterData:
    """Keep the postures with a known bone and enough visible markers; without any such posture, keep no marker."""
    known = np.isfinite(data.postures).all(-1).sum(1) >= MINIMUM_MARKERS
    kept = data.postures[known]
    seen = np.isfinite(kept).all(-1).any(0) & bool(known.any())
    return replace(
        data, labels=tuple(label for label, there in zip(data.labels, seen, strict=True) if there),
        points=data.points[:, seen], postures=kept[:, seen], frames=data.frames[known],
        rotation=data.rotation[known], origin=data.origin[known],
    )  # fmt: skip


def _restricted(problem: MarkerProblem, able: list[ClusterData]) -> MarkerProblem:
    """Keep the usable clusters, and the joints between them whose bones are both known in some posture."""
    names = {data.segment: set(data.frames.tolist()) for data in able}
    joints = tuple(pair for pair in problem.joints if set(pair) <= set(names) and names[pair[0]] & names[pair[1]])
    clusters = tuple(cluster for cluster in problem.clusters if cluster.segment in names)
    return replace(problem, clusters=clusters, joints=joints, degrees_of_freedom=())


def _estimate_jointly(
    problem: MarkerProblem, clusters: list[ClusterData], settings: SkinAndJointsSettings
) -> BoneMotion:  # fmt: skip
    """Estimate the bones of usable clusters in rounds, each with the joints' rotations of the previous one."""
    motion = combine_bones([rigid_bone(data, problem.noise_m) for data in clusters])
    skins: tuple[SkinMotion, ...] = ()
    for _ in range(settings.rounds):
        skins = _skin_models(problem, clusters, motion, skins, settings)
        pairs = zip(clusters, skins, strict=True)
        fitted = [_fitted_cluster(data, skin, problem.noise_m, settings) for data, skin in pairs]
        joints = [_joint(problem, motion, pair, settings.joints) for pair in problem.joints]
        steps, covariance, factors = _common_motions([cluster.pose for cluster in fitted], joints, settings.steps)
        motion = _motion(fitted, steps, covariance)
    return replace(motion, notes=(*motion.notes, *_skin_notes(skins), *_joint_notes(problem, joints, factors)))


def _skin_models(
    problem: MarkerProblem, clusters: list[ClusterData], motion: BoneMotion, before: tuple[SkinMotion, ...],
    settings: SkinAndJointsSettings,
) -> tuple[SkinMotion, ...]:  # fmt: skip
    """Estimate the models of the skins' motions once, and update the joints' rotations in them afterwards."""
    turns = []
    for data in clusters:
        found = segment_turn(problem, motion, data.segment)
        turns.append(np.zeros(len(motion)) if found is None else _continuous_turn(found, problem))
    if before:
        return tuple(replace(skin, turn=turn) for skin, turn in zip(before, turns, strict=True))
    time = problem.trajectories.time
    pairs = zip(clusters, turns, strict=True)
    learned = [learn_skin(data, turn, time, problem.noise_m, settings.skin) for data, turn in pairs]

    return shrink_sizes(learned, settings.skin)


def _continuous_turn(found: JointTurn, problem: MarkerProblem) -> Floats:
    """Return a rotation (F,) [rad] without gaps, with the known values in the known postures."""
    turn = np.array(found.turn)
    known = np.isfinite(found.at_postures)
    turn[problem.calibration.frames[known]] = found.at_postures[known]
    return without_gaps(turn)


def _fitted_cluster(
    data: ClusterData, skin: SkinMotion, noise_m: float, settings: SkinAndJointsSettings
) -> _FittedCluster:  # fmt: skip
    """Fit a cluster's shape, interpolated between the known postures, with the prior of its motion over the bone."""
    frames = np.arange(len(data.points))
    weights, variance = krige(skin.semivariance(frames, data.frames), skin.semivariance(data.frames, data.frames))
    places = np.einsum("fk,kmi->fmi", weights, filled_postures(data))
    fit = fit_rigid(places, data.points, noise_m * np.sqrt(2) * skin.relative_sd)
    reference = places[data.frames[0]]
    variance = variance * _outlier_factor(fit, skin, variance, noise_m, settings.outlier_variance_ratio)
    return _FittedCluster(data=data, skin=skin, fit=fit, pose=ClusterPose(
        rotation=fit.rotation, origin=fit.translation, centre=_centre(reference, skin.relative_sd),
        prior=_common_motion_prior(reference, skin.size, settings) * variance[:, None, None],
    ))  # fmt: skip


def _outlier_factor(fit: RigidFit, skin: SkinMotion, variance: Floats, noise_m: float, largest_ratio: float) -> Floats:
    """Return the factor (F,) by which a frame's motion exceeds the expected one, at least 1."""
    used: Mask = np.asarray(np.isfinite(fit.residuals).all(-1))
    free = np.maximum(3 * used.sum(1) - 6, 1)
    seen = np.where(used[..., None], np.nan_to_num(fit.residuals) ** 2, 0.0).sum((1, 2)) / free
    expected = skin.size**2 / 3 * variance + 2 * noise_m**2
    return np.asarray(np.maximum(seen / (largest_ratio * expected), 1.0))


def _centre(places: Floats, relative_sd: Floats) -> Floats:
    weight = 1 / relative_sd**2
    return np.asarray(weight @ places / weight.sum())


def _common_motion_prior(places: Floats, size: float, settings: SkinAndJointsSettings) -> Floats:
    """Return the covariance (6, 6) of the skin's common rotation [rad] and translation [m] over a bone.

    A common translation is proportional to the visible motion. So is the displacement of the markers by a common
    rotation, which therefore has a larger angle about the long axis of a slender cluster.
    """
    about = places - places.mean(0)
    inertia = ((about**2).sum() * (1 + _MINIMUM_INERTIA_RATIO) * np.eye(3) - about.T @ about) / len(places)
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = (settings.common_rotation_ratio * size) ** 2 * np.linalg.inv(inertia)
    covariance[3:, 3:] = (settings.common_translation_ratio * size) ** 2 / 3 * np.eye(3)
    return covariance


def _joint(
    problem: MarkerProblem, motion: BoneMotion, pair: tuple[str, str], settings: JointConstraintSettings
) -> KnownJoint:
    calibration, names = problem.calibration, [cluster.segment for cluster in problem.clusters]
    poses = []
    for segment in pair:
        index = calibration.segments.index(segment)
        poses.append((calibration.rotation[:, index], calibration.origin[:, index]))
    known = np.isfinite(poses[0][0]).all((1, 2)) & np.isfinite(poses[1][0]).all((1, 2))
    poses = [(rotation[known], origin[known]) for rotation, origin in poses]
    turn = _continuous_turn(joint_turn(problem, motion, *pair), problem)
    parent, child = motion.bone(pair[0])[0], motion.bone(pair[1])[0]
    return KnownJoint(
        parent=names.index(pair[0]), child=names.index(pair[1]), laxity=laxity(*pair, settings),
        frames=calibration.frames[known],
        parent_pose=poses[0], child_pose=poses[1], turn=turn, time=problem.trajectories.time,
        anatomical=is_anatomical(np.swapaxes(parent, 1, 2) @ child, settings), settings=settings,
    )  # fmt: skip


def _common_motions(
    poses: list[ClusterPose], joints: list[KnownJoint], steps_count: int
) -> tuple[Floats, Floats, list[Floats]]:
    """Estimate the clusters' common motions by Gauss-Newton.

    Returns:
        The motions (F, S, 6) and their covariance (F, S, 6, 6), and the factors (R,) of each joint's variances.
    """
    frames = len(poses[0].origin)
    steps = np.zeros((frames, len(poses), 6))
    covariance = np.stack([pose.prior for pose in poses], 1)
    guesses = [initial_centres(joint, poses) for joint in joints]
    centres = list(guesses)
    factors: list[Floats] = [np.ones(0) for _ in joints]
    for step in range(steps_count if joints else 0):
        rows = []
        for k, joint in enumerate(joints):
            centres[k] = refined_centres(joint, poses, steps, centres[k], guesses[k][0])
            found = joint_rows(joint, poses, steps, centres[k])
            if step == 0:
                factors[k] = laxity_factors(joint, poses, found)
            rows.append(replace(found, sd=found.sd * np.sqrt(factors[k])))
        wrt, value, variance = _stacked_equations(joints, rows, steps)
        for start in range(0, frames, _CHUNK):
            part = slice(start, start + _CHUNK)
            prior = np.stack([pose.prior[part] for pose in poses], 1)
            steps[part], covariance[part] = _update(prior, wrt[part], value[part], variance[part])
    return steps, covariance, factors


def _stacked_equations(
    joints: list[KnownJoint], rows: list[ConstraintRows], steps: Floats
) -> tuple[Floats, Floats, Floats]:
    """Stack all joints' derivatives (F, R, S, 6), values (F, R) at zero motion and variances (F, R)."""
    frames, count = steps.shape[:2]
    wrts, values = [], []
    for joint, row in zip(joints, rows, strict=True):
        wrt = np.zeros((frames, row.wrt.shape[1], count, 6))
        wrt[:, :, joint.parent], wrt[:, :, joint.child] = row.wrt[..., :6], row.wrt[..., 6:]
        wrts.append(wrt)
        values.append(row.residual + np.einsum("frsk,fsk->fr", wrt, steps))
    variance = np.concatenate([row.sd**2 for row in rows], 1) + _MINIMUM_VARIANCE
    return np.concatenate(wrts, 1), np.concatenate(values, 1), variance


def _update(prior: Floats, wrt: Floats, value: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """Update independent priors (n, S, 6, 6) with equations (n, R, S, 6): return means and marginal covariances."""
    count, rows, segments = wrt.shape[:3]
    gathered = np.einsum("nskl,nrsl->nskr", prior, wrt)
    scatter = np.einsum("nrsk,nskq->nrq", wrt, gathered)
    scatter[:, np.arange(rows), np.arange(rows)] += variance
    flat = gathered.reshape(count, segments * 6, rows)
    gain = np.swapaxes(np.linalg.solve(scatter, np.swapaxes(flat, 1, 2)), 1, 2).reshape(count, segments, 6, rows)
    return np.einsum("nskr,nr->nsk", gain, value), prior - np.einsum("nskr,nslr->nskl", gain, gathered)


def _motion(fitted: list[_FittedCluster], steps: Floats, covariance: Floats) -> BoneMotion:
    """Remove the common motions, and add their uncertainty to that of the noise."""
    bones = []
    for index, cluster in enumerate(fitted):
        rotation, origin = cluster.pose.moved(steps[:, index])
        wrt = np.zeros((len(rotation), 6, 6))
        wrt[:, :3, :3] = np.eye(3)
        wrt[:, 3:, :3] = rotation @ rotations.hat(cluster.pose.centre)
        wrt[:, 3:, 3:] = rotation
        skin = wrt @ covariance[:, index] @ np.swapaxes(wrt, 1, 2)
        notes = (
            *cluster.data.notes,
            *frame_count_note(
                cluster.data.segment, cluster.fit.few, f"have fewer than {MINIMUM_MARKERS} markers and no result"
            ),
            *frame_count_note(cluster.data.segment, cluster.fit.collinear, "have collinear markers and no result"),
        )
        bones.append(one_bone(cluster.data.segment, rotation, origin, skin + cluster.fit.noise_covariance, notes))
    return combine_bones(bones)


def _skin_notes(skins: tuple[SkinMotion, ...]) -> tuple[str, ...]:
    """Report for each cluster the size of its skin's motion, and what it follows."""
    notes = []
    for skin in skins:
        if skin.size == 0:
            notes.append(f"{skin.segment}: the cluster is rigid within its noise; no skin motion is assumed.")
            continue
        form = skin.form
        shares = (
            f"{100 * form.turn:.0f} % follow the joint's rotation, {100 * form.modes:.0f} % follow "
            f"{count_of(form.rank, 'further pattern')} that the markers share, {100 * form.wobble:.0f} % neither"
        )
        notes.append(
            f"{skin.segment}: the skin is estimated to slide by {1000 * skin.size:.1f} mm over the bone since the "
            f"reference posture (RMS of a marker); the stated deviations include it. Of its variance {shares}."
        )
    return tuple(notes)


def _joint_notes(problem: MarkerProblem, joints: list[KnownJoint], factors: list[Floats]) -> tuple[str, ...]:
    """Report the joints whose angles are not constrained, and those that are constrained less than usual."""
    names, notes = [cluster.segment for cluster in problem.clusters], list[str]()
    for joint, found in zip(joints, factors, strict=True):
        pair = f"{names[joint.parent]} and {names[joint.child]}"
        held = [name for name in ("adduction", "rotation") if getattr(joint.laxity, name) is not None]
        if not joint.anatomical and held:
            notes.append(
                f"{pair}: the joint does not rotate about the bones' Z axes, so that its usual {' and '.join(held)} "
                "cannot be assumed."
            )
            continue
        # The equations of the small rotations are the last ones; without any step of the estimation there are none.
        for name, factor in zip(reversed(held), reversed(found), strict=False):
            if factor > 1:
                notes.append(
                    f"{pair}: the {name} varies more than is usual for the joint and the skin. Its standard deviation "
                    f"in the joint was increased by a factor of {np.sqrt(factor):.1f}, and less skin motion is removed."
                )
    return tuple(notes)
