"""Global optimisation: all bones of a chain at once, with joints as constraints, without an external model."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.errors import MareyError
from marey.geometry import rotations
from marey.geometry.vectors import products
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.cluster_data import ClusterData, cluster_data
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.rigid_fit import rigid
from marey.markers.methods.chain import RIGID_SD_M, ChainJoint, JointPlace
from marey.markers.methods.chain_equations import (
    Chain,
    ChainState,
    ChainStep,
    MarkerObservations,
    descend,
    linearise,
    marker_residuals,
    marker_rows,
    solve,
)
from marey.markers.methods.joint_constraints import JOINT_CONSTRAINT_DEFAULTS
from marey.markers.methods.joint_turn import segment_turn
from marey.markers.methods.multiple_calibration import multiple_calibration, places_at
from marey.wording import listed

_HINGED = ("shank", "forearm")
"""Distal segments of the joints that `global_hinge` models as hinges: knees and elbows."""
_MINIMUM_SD_M = 1e-6
"""Smallest standard deviation of a marker [m]; numerical."""


@dataclass(frozen=True, kw_only=True)
class GlobalOptimisationSettings:
    """Settings of the global optimisation.

    The defaults were chosen by hand unless a field states otherwise; results were not measured against other values.
    """

    weighting_rounds: int = 1
    """Rounds in which markers are weighted by their residuals; further rounds come to favour a few markers."""
    centre_prior_sd_m: float = 0.1
    """Standard deviation of a joint's centre about the midpoint between two clusters [m]."""
    independent_frames: float = JOINT_CONSTRAINT_DEFAULTS.independent_frames
    """A trial carries as much information on a joint as this number of frames, because the errors of skin markers are
    correlated between neighbouring frames."""
    independent_hinge_sightings: float = 10.0
    """The same for a hinge, in sightings of markers: its centre is not determined along the axis."""
    known_posture_sd_m: float = 1e-3
    """Standard deviation of a rigid constraint's gap for measured bones in a known posture [m]."""
    initial_slack: float = 10.0
    """Factor of the standard deviation of a rigid constraint in the first rounds."""
    rigid_ratio: float = 0.1
    """Standard deviation of a rigid constraint as a ratio to that of the best marker, at most `RIGID_SD_M`."""
    largest_sd: float = 0.5
    """A bone with a larger standard deviation has no result [rad or m]."""
    soft_sd_m: float = 5e-3
    """Standard deviation of the gap of joint centres in `global_soft` [m]."""


_SETTINGS = GlobalOptimisationSettings()
"""Default settings of the method."""


@dataclass(frozen=True, eq=False, kw_only=True)
class GlobalOptimisation:
    """The bones of a chain, with the estimated joints and marker errors."""

    bones: BoneMotion
    joints: tuple[ChainJoint, ...]
    centres_in_parent: Floats
    """(J, 3) joint centres in the parents' frames [m]."""
    centres_in_child: Floats
    """(J, 3) joint centres in the children's frames [m]."""
    axes: Floats
    """(J, 3) axes of the first rotation, in the parent; meaningful for one or two degrees of freedom only."""
    marker_sd: tuple[Floats, ...]
    """For each segment (M,) standard deviation of its markers' residuals [m]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "centres_in_parent", "centres_in_child", "axes")


def global_ball(problem: MarkerProblem, settings: GlobalOptimisationSettings = _SETTINGS) -> BoneMotion:
    """Estimate all bones together, with ball joints unless the problem specifies degrees of freedom ([Lu1999])."""
    return optimise_chain(problem, _joints(problem), settings).bones


def global_hinge(problem: MarkerProblem, settings: GlobalOptimisationSettings = _SETTINGS) -> BoneMotion:
    """Estimate all bones together, with hinges as knees and elbows and the other joints as in `global_ball`.

    Raises:
        MareyError: No joint is a knee or an elbow by the name of its distal segment.
    """
    joints = _joints(problem)
    hinges = [j.child.rpartition("_")[2] in _HINGED for j in joints]
    if not any(hinges):
        raise MareyError(f"No joint is a hinge: none ends in a segment called {' or '.join(_HINGED)}.")
    held = [replace(j, degrees_of_freedom=1) if h else j for j, h in zip(joints, hinges, strict=True)]
    return optimise_chain(problem, held, settings).bones


def global_soft(problem: MarkerProblem, settings: GlobalOptimisationSettings = _SETTINGS) -> BoneMotion:
    """Estimate all bones together, each joint with six degrees of freedom and its centre softly constrained (5 mm)."""
    soft = [ChainJoint(parent=p, child=c, degrees_of_freedom=6, sd_m=settings.soft_sd_m) for p, c in problem.joints]
    return optimise_chain(problem, soft, settings).bones


def _joints(problem: MarkerProblem) -> list[ChainJoint]:
    """Return the problem's joints with their degrees of freedom; ball joints where none are specified."""
    specified = problem.degrees_of_freedom or (None,) * len(problem.joints)
    ends = zip(problem.joints, specified, strict=True)
    return [ChainJoint(parent=p, child=c, degrees_of_freedom=n or 3) for (p, c), n in ends]


def optimise_chain(
    problem: MarkerProblem, joints: Sequence[ChainJoint], settings: GlobalOptimisationSettings = _SETTINGS
) -> GlobalOptimisation:
    """Estimate the bones of a chain and their joints by one least-squares problem over the whole trial ([Lu1999]).

    Unlike the paper, joints may have one to six degrees of freedom and soft constraints, their positions are estimated
    with the motion unless given, and each marker is weighted by the size of its residuals over the trial. With several
    known postures the markers' positions follow the joint's rotation between them ([Cappello1997]).

    Args:
        problem: The trial.
        joints: Joints between segments of the problem.
        settings: Settings of the method.

    Returns:
        The bones with their covariance; NaN in frames in which markers and joints do not determine a bone. Skin motion
        common to a whole segment, which residuals show only as far as the joints resist it, is assumed to be as large
        as the motion of the markers relative to each other.

    Raises:
        MareyError: A joint connects segments without markers, there is no joint, or no known posture shows a marker of
            one of the segments.
    """
    segments = tuple(cluster.segment for cluster in problem.clusters)
    for joint in joints:
        for end in (joint.parent, joint.child):
            if end not in segments:
                raise MareyError(f"A joint connects {end!r}, which has no markers. Segments: {', '.join(segments)}.")
    if not joints:
        raise MareyError("Global optimisation needs a joint between two segments.")
    data = [cluster_data(problem, cluster) for cluster in problem.clusters]
    unseen = [each.segment for each in data if not each.labels]
    if unseen:
        raise MareyError(
            f"Global optimisation needs the markers of every segment in a known posture, which shows none of "
            f"{listed(unseen)}. Give the poses of the bones in a frame with these markers, or leave out the segment."
        )
    motion = multiple_calibration(problem) if problem.calibration.postures > 1 else rigid(problem)
    chain, state = _start(problem, data, joints, motion, settings)
    for _ in range(settings.weighting_rounds):
        state, step = descend(_with_rigid_sd(chain, settings.initial_slack, settings), state)
        chain = replace(chain, shapes=_weighted_by_residuals(chain, state, step))
    # A rigid constraint makes a narrow, curved valley; a wider one at first allows long steps.
    for slack in (settings.initial_slack, 1.0):
        chain = _with_rigid_sd(chain, slack, settings)
        state, _ = descend(chain, state)
    # No marker is more accurate than its measurement, however rigid its cluster.
    stated = replace(chain, shapes=tuple(s._replace(sd=np.maximum(s.sd, problem.noise_m)) for s in chain.shapes))
    stated = _with_rigid_sd(stated, 1.0, settings)
    covariance = solve(stated, linearise(stated, state), 0.0).covariance
    skin = _common_skin_covariance(stated, state, covariance, problem.noise_m)
    return _result(data, chain, state, covariance, skin, settings)


def _start(
    problem: MarkerProblem, data: Sequence[ClusterData], joints: Sequence[ChainJoint], motion: BoneMotion,
    settings: GlobalOptimisationSettings,
) -> tuple[Chain, ChainState]:  # fmt: skip
    """Set up the least-squares problem, starting from the bones estimated by their clusters alone."""
    segments = tuple(d.segment for d in data)
    known = _known(problem, segments)
    places = [_places(problem, d, motion) for d in data]
    poses = [_filled(motion, d, known[0][0, s], known[1][0, s]) for s, d in enumerate(data)]
    rotation, origin = np.stack([r for r, _ in poses], 1), np.stack([o for _, o in poses], 1)
    shapes = tuple(_shape(d, p, r, o, problem.noise_m) for d, p, (r, o) in zip(data, places, poses, strict=True))
    sightings = sum(int(shape.used.sum()) for shape in shapes)
    ends = tuple((segments.index(j.parent), segments.index(j.child)) for j in joints)
    first = [_between(data, known, pair) for pair in ends]
    begun = [
        _joint_start(j, pair, middle, known, rotation, origin)
        for j, pair, middle in zip(joints, ends, first, strict=True)
    ]
    chain = Chain(
        shapes=shapes, joints=tuple(joints), ends=ends, known=known,
        estimated=np.stack([_estimated(j) for j in joints]),
        start=tuple(place._replace(in_parent=p, in_child=c) for place, (p, c) in zip(begun, first, strict=True)),
        prior_sd=np.stack([_prior_sd(j, len(rotation), sightings, settings) for j in joints]),
        known_sd=settings.known_posture_sd_m, rigid_sd_m=RIGID_SD_M,
    )  # fmt: skip
    return chain, ChainState(rotation, origin, tuple(begun))


def _known(problem: MarkerProblem, segments: Sequence[str]) -> tuple[Floats, Floats]:
    """Return the known postures of the segments in their order: (K, S, 3, 3) and (K, S, 3) [m]."""
    index = [problem.calibration.segments.index(name) for name in segments]
    return problem.calibration.rotation[:, index], problem.calibration.origin[:, index]


def _places(problem: MarkerProblem, data: ClusterData, motion: BoneMotion) -> Floats:
    """Return the markers' positions on the bone (F, M, 3) [m], following the joint's rotation between postures."""
    turn = segment_turn(problem, motion, data.segment) if problem.calibration.postures > 1 else None
    if turn is None or turn.between_postures == 0:
        return np.asarray(np.broadcast_to(data.reference, data.points.shape))
    places = places_at(turn.turn, turn.at_postures, data.postures)
    return np.asarray(np.where(np.isfinite(places), places, data.reference))


def _filled(motion: BoneMotion, data: ClusterData, rotation: Floats, origin: Floats) -> tuple[Floats, Floats]:
    """Return a bone's pose in every frame; where its cluster has no result, that of the nearest frame with one."""
    index = motion.segments.index(data.segment)
    turns, origins = np.array(motion.rotation[:, index]), np.array(motion.origin[:, index])
    if not motion.answered[data.frames[0], index]:
        turns[data.frames[0]], origins[data.frames[0]] = rotation, origin
    there = np.flatnonzero(np.isfinite(turns).all((1, 2)))
    nearest = there[np.abs(np.arange(len(turns))[:, None] - there).argmin(1)]
    return turns[nearest], origins[nearest]


def _shape(data: ClusterData, places: Floats, rotation: Floats, origin: Floats, noise_m: float) -> MarkerObservations:
    """Collect the observations of one bone, with equal weights of all its markers."""
    used: Mask = np.asarray(np.isfinite(data.points).all(-1) & np.isfinite(places).all(-1))
    shape = MarkerObservations(
        np.where(used[..., None], places, 0.0), np.where(used[..., None], data.points, 0.0), used,
        np.ones(len(data.labels)),
    )  # fmt: skip
    off = marker_residuals(shape, rotation, origin)[used]
    size = np.sqrt((off**2).mean()) if len(off) else 0.0
    return shape._replace(sd=np.full(len(data.labels), max(float(size), noise_m, _MINIMUM_SD_M)))


def _between(data: Sequence[ClusterData], known: tuple[Floats, Floats], ends: tuple[int, int]) -> tuple[Floats, Floats]:
    """Return the midpoint between two clusters in the first known posture, in the parent and in the child [m]."""
    rotation, origin = known[0][0], known[1][0]
    middles = [rotation[s] @ data[s].reference.mean(0) + origin[s] for s in ends]
    middle = 0.5 * (middles[0] + middles[1])
    parent, child = ends
    return rotation[parent].T @ (middle - origin[parent]), rotation[child].T @ (middle - origin[child])


def _joint_start(
    joint: ChainJoint, ends: tuple[int, int], middle: tuple[Floats, Floats], known: tuple[Floats, Floats],
    rotation: Floats, origin: Floats,
) -> JointPlace:  # fmt: skip
    """Estimate a joint from freely moving bones: the point that moves least in both, and the axes of most rotation."""
    parent, child = ends
    neutral = known[0][0, parent].T @ known[0][0, child]
    inverse = np.swapaxes(rotation[:, parent], 1, 2)
    relative = inverse @ rotation[:, child]
    between = products(inverse, origin[:, child] - origin[:, parent])
    if joint.centre is None:
        at = _still_point(relative, between, np.concatenate(middle))
    else:
        reach = known[0][:, parent] @ joint.centre + known[1][:, parent] - known[1][:, child]
        in_child = np.einsum("kij,ki->kj", known[0][:, child], reach).mean(0)
        at = np.concatenate([joint.centre, in_child])
    turns = rotations.log(relative @ neutral.T)
    main = np.linalg.eigh(turns.T @ turns)[1][:, ::-1]
    axis = main[:, 0] if joint.axis is None else joint.axis / np.linalg.norm(joint.axis)
    second = main[:, 1] - (main[:, 1] @ axis) * axis
    if np.linalg.norm(second) < 0.1:
        second = main[:, 0] - (main[:, 0] @ axis) * axis
    held = np.eye(3)
    if joint.degrees_of_freedom in (4, 5):
        moves = between + relative @ at[3:]
        moves = moves - moves.mean(0)
        held = np.linalg.eigh(moves.T @ moves)[1][:, : joint.constrained_translations].T
    return JointPlace(
        at[:3], at[3:], axis, second / np.linalg.norm(second), held[: joint.constrained_translations], neutral
    )


def _still_point(relative: Floats, between: Floats, near: Floats) -> Floats:
    """Find the point (6,) of parent and child whose two positions are closest to each other, near a prior."""
    rows = np.concatenate([np.broadcast_to(-np.eye(3), relative.shape), relative], -1)
    system = np.einsum("fia,fib->ab", rows, rows)
    # A hundredth of a frame's information keeps it in place along an axis about which everything rotates.
    hold = 1e-2 * np.eye(6)
    return np.linalg.solve(system + hold, hold @ near - np.einsum("fia,fi->a", rows, between))


def _prior_sd(joint: ChainJoint, frames: int, sightings: int, settings: GlobalOptimisationSettings) -> Floats:
    """Return the prior standard deviations of a joint's parameters (10,), scaled for a sum over all frames."""
    worth = (
        sightings / settings.independent_hinge_sightings
        if joint.constrained_rotations == 2
        else frames / settings.independent_frames
    )
    return np.asarray(np.array([settings.centre_prior_sd_m] * 6 + [np.pi] * 4) / np.sqrt(max(1.0, worth)))


def _estimated(joint: ChainJoint) -> Mask:
    """Find the joint's parameters (10,) that are estimated."""
    centre = joint.constrained_translations > 0 and joint.centre is None
    first, second = joint.constrained_rotations in (1, 2) and joint.axis is None, joint.constrained_rotations == 1
    return np.array([centre] * 6 + [first] * 2 + [second] * 2, bool)


def _with_rigid_sd(chain: Chain, slack: float, settings: GlobalOptimisationSettings) -> Chain:
    """Set the standard deviation of rigid constraints from that of the best marker, times a slack factor."""
    best = min(float(shape.sd.min()) for shape in chain.shapes)
    return replace(chain, rigid_sd_m=slack * min(RIGID_SD_M, settings.rigid_ratio * best))


def _weighted_by_residuals(chain: Chain, state: ChainState, step: ChainStep) -> tuple[MarkerObservations, ...]:
    """Set each marker's standard deviation from its residuals, corrected for the leverage of the marker.

    The variance is shrunk towards that of the cluster with the weight of one frame.
    """
    shapes = []
    for s, shape in enumerate(chain.shapes):
        at = slice(6 * s, 6 * s + 6)
        rows = marker_rows(shape, state.rotation[:, s])
        drawn = np.einsum("fmia,fab,fmib->fm", rows, step.covariance[:, at, at], rows) / shape.sd**2
        spare = np.where(shape.used, 3 - np.minimum(drawn, 3.0), 0.0).sum(0)
        squares = (marker_residuals(shape, state.rotation[:, s], state.origin[:, s]) ** 2).sum((0, 2))
        pooled = squares.sum() / max(float(spare.sum()), 1e-9)
        sd = np.sqrt((squares + 3 * pooled) / (spare + 3))
        shapes.append(shape._replace(sd=np.maximum(sd, _MINIMUM_SD_M)))
    return tuple(shapes)


def _common_skin_covariance(chain: Chain, state: ChainState, covariance: Floats, noise_m: float) -> Floats:
    """Return the contribution of skin motion common to a segment to the covariance (F, 6 S, 6 S) of the poses.

    Ours: residuals do not show it, so it is assumed to be as large as the residuals beyond the measurement noise: all
    markers of a segment together then carry no more information on the bone than one of them.
    """
    information = np.zeros_like(covariance)
    for s, shape in enumerate(chain.shapes):
        at = slice(6 * s, 6 * s + 6)
        skin = np.sqrt(np.maximum(1 - (noise_m / shape.sd) ** 2, 0.0)) / shape.sd
        rows = (marker_rows(shape, state.rotation[:, s]) * skin[:, None, None]).reshape(len(covariance), -1, 6)
        information[:, at, at] = shape.used.sum(1)[:, None, None] * (np.swapaxes(rows, 1, 2) @ rows)
    return np.asarray(covariance @ information @ covariance)


def _result(
    data: Sequence[ClusterData], chain: Chain, state: ChainState, noise: Floats, skin: Floats,
    settings: GlobalOptimisationSettings,
) -> GlobalOptimisation:  # fmt: skip
    """Return the bones with both parts of their covariance; NaN for undetermined ones."""
    count, segments = state.rotation.shape[:2]
    blocks = [part.reshape(count, segments, 6, segments, 6) for part in (noise, noise + skin)]
    alone, covariance = (np.stack([b[:, s, :, s] for s in range(segments)], 1) for b in blocks)
    variance = np.diagonal(alone, axis1=-2, axis2=-1)
    undetermined = ~np.asarray(((variance >= 0) & (variance <= settings.largest_sd**2)).all(-1))
    notes = [note for d in data for note in d.notes]
    for d, lost in zip(data, undetermined.T, strict=True):
        if lost.any():
            notes.append(f"{d.segment}: {int(lost.sum())} of {count} frames have no result: too few markers.")
    bones = BoneMotion(
        segments=tuple(d.segment for d in data),
        rotation=np.where(undetermined[..., None, None], np.nan, state.rotation),
        origin=np.where(undetermined[..., None], np.nan, state.origin),
        covariance=np.where(undetermined[..., None, None], np.nan, covariance), notes=tuple(notes),
    )  # fmt: skip
    return GlobalOptimisation(
        bones=bones, joints=chain.joints,
        centres_in_parent=np.stack([j.in_parent for j in state.joints]),
        centres_in_child=np.stack([j.in_child for j in state.joints]),
        axes=np.stack([j.axis for j in state.joints]), marker_sd=tuple(shape.sd for shape in chain.shapes),
    )  # fmt: skip
