"""Global optimisation: all bones of a chain at once, their joints as constraints, without a model from elsewhere."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.errors import MareyError
from marey.geometry import rotations
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.cluster_data import ClusterData, cluster_data
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.rigid_fit import rigid
from marey.markers.methods.chain import FAST_M, ChainJoint, JointPlace
from marey.markers.methods.chain_equations import (
    Chain,
    Shape,
    State,
    Step,
    build,
    descend,
    marker_residuals,
    marker_rows,
    solve,
)
from marey.markers.methods.joint_turn import segment_turn
from marey.markers.methods.multiple_calibration import multiple_calibration, places_at

_ROUNDS = 1  # of weights from residuals; weights that feed on themselves come to favour a few markers
_REACH = 0.1  # m; how far a joint's centre lies from the middle between two clusters
_TRIAL_FRAMES = 5  # skin errs alike in neighbouring frames: a trial says no more of a joint than so many frames do
_HINGE_SIGHTINGS = 10  # the same for a hinge, in sightings of markers: its centre lies anywhere along the axis
_KNOWN_SD = 1e-3  # m; how well a joint held fast fits bones that were measured
_SLACK = 10.0  # by which a joint held fast is wider at first
_OPEN = 0.5  # rad or m; a bone that is not known better has no answer
_LEAST_SD = 1e-6  # m
_HINGED = ("shank", "forearm")
_SOFT = 5e-3  # m


@dataclass(frozen=True, eq=False, kw_only=True)
class GlobalOptimisation:
    """The bones of a chain, and what was learned with them."""

    bones: BoneMotion
    joints: tuple[ChainJoint, ...]
    centres_in_parent: Floats
    """(J, 3) [m]."""
    centres_in_child: Floats
    """(J, 3) [m]."""
    axes: Floats
    """(J, 3) of the first turn, in the parent; it says something with one or two degrees of freedom only."""
    marker_sd: tuple[Floats, ...]
    """For each segment (M,) the size of its markers' residuals [m]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "centres_in_parent", "centres_in_child", "axes")


def global_ball(problem: MarkerProblem) -> BoneMotion:
    """Move all bones together, each joint a ball joint unless the problem says its degrees of freedom ([Lu1999])."""
    return optimise_chain(problem, _joints(problem)).bones


def global_hinge(problem: MarkerProblem) -> BoneMotion:
    """Move all bones together, knees and elbows as hinges, the other joints as `global_ball` does.

    Raises:
        MareyError: No joint is a knee or an elbow by the name of its distal segment.
    """
    joints = _joints(problem)
    hinges = [j.child.rpartition("_")[2] in _HINGED for j in joints]
    if not any(hinges):
        raise MareyError(f"No joint is a hinge: none ends in a segment called {' or '.join(_HINGED)}.")
    held = [replace(j, degrees_of_freedom=1) if h else j for j, h in zip(joints, hinges, strict=True)]
    return optimise_chain(problem, held).bones


def global_soft(problem: MarkerProblem) -> BoneMotion:
    """Move all bones together, each joint free in all six degrees, its centre held softly (5 mm)."""
    soft = [ChainJoint(parent=p, child=c, degrees_of_freedom=6, sd_m=_SOFT) for p, c in problem.joints]
    return optimise_chain(problem, soft).bones


def _joints(problem: MarkerProblem) -> list[ChainJoint]:
    """Give the problem's joints with their degrees of freedom, ball joints where it does not say."""
    said = problem.degrees_of_freedom or (None,) * len(problem.joints)
    ends = zip(problem.joints, said, strict=True)
    return [ChainJoint(parent=p, child=c, degrees_of_freedom=n or 3) for (p, c), n in ends]


def optimise_chain(problem: MarkerProblem, joints: Sequence[ChainJoint]) -> GlobalOptimisation:
    """Estimate the bones of a chain with their joints as one least squares over the whole trial ([Lu1999]).

    Unlike the paper, joints may have one to six degrees of freedom and be held softly, their places are estimated with
    the motion unless they are given, and each marker counts by the size that its residuals have over the trial. With
    several known postures the markers' places follow the joint's turn between them ([Cappello1997]).

    Args:
        problem: The trial. Frames in which a bone's markers and joints do not tell its pose are NaN.
        joints: Between segments of the problem.

    Returns:
        The bones with their covariance. Skin that moves with its whole segment, which residuals show only as far as the
        joints resist it, is taken to move as much as the markers move against each other.

    Raises:
        MareyError: A joint ties segments that have no markers, or there is none.
    """
    segments = tuple(cluster.segment for cluster in problem.clusters)
    for joint in joints:
        for end in (joint.parent, joint.child):
            if end not in segments:
                raise MareyError(f"A joint ties {end!r}, which has no markers. There are: {', '.join(segments)}.")
    if not joints:
        raise MareyError("Global optimisation needs a joint between two segments.")
    data = [cluster_data(problem, cluster) for cluster in problem.clusters]
    motion = multiple_calibration(problem) if problem.calibration.postures > 1 else rigid(problem)
    chain, state = _start(problem, data, joints, motion)
    for _ in range(_ROUNDS):
        state, step = descend(_hold(chain, _SLACK), state)
        chain = replace(chain, shapes=_weighed(chain, state, step))
    # A joint held fast makes a narrow, bent valley; one that is wider at first is followed in long steps.
    for slack in (_SLACK, 1.0):
        chain = _hold(chain, slack)
        state, _ = descend(chain, state)
    # No marker is better than its measurement, however well a cluster keeps its shape.
    stated = replace(chain, shapes=tuple(s._replace(sd=np.maximum(s.sd, problem.noise_m)) for s in chain.shapes))
    stated = _hold(stated, 1.0)
    covariance = solve(stated, build(stated, state), 0.0).covariance
    return _result(data, chain, state, covariance, _moving_together(stated, state, covariance, problem.noise_m))


def _start(
    problem: MarkerProblem, data: Sequence[ClusterData], joints: Sequence[ChainJoint], motion: BoneMotion
) -> tuple[Chain, State]:
    """Set the least squares up, and begin with the bones as their clusters alone give them."""
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
        prior_sd=np.stack([_prior_sd(j, len(rotation), sightings) for j in joints]),
        known_sd=_KNOWN_SD, fast_m=FAST_M,
    )  # fmt: skip
    return chain, State(rotation, origin, tuple(begun))


def _known(problem: MarkerProblem, segments: Sequence[str]) -> tuple[Floats, Floats]:
    """Give the known postures of the segments in their order: (K, S, 3, 3) and (K, S, 3)."""
    index = [problem.calibration.segments.index(name) for name in segments]
    return problem.calibration.rotation[:, index], problem.calibration.origin[:, index]


def _places(problem: MarkerProblem, data: ClusterData, motion: BoneMotion) -> Floats:
    """Give the markers' places on the bone in every frame (F, M, 3): between known postures they follow the joint."""
    turn = segment_turn(problem, motion, data.segment) if problem.calibration.postures > 1 else None
    if turn is None or turn.between_postures == 0:
        return np.asarray(np.broadcast_to(data.reference, data.points.shape))
    places = places_at(turn.turn, turn.at_postures, data.postures)
    return np.asarray(np.where(np.isfinite(places), places, data.reference))


def _filled(motion: BoneMotion, data: ClusterData, rotation: Floats, origin: Floats) -> tuple[Floats, Floats]:
    """Give a bone's pose in every frame, where its cluster has no answer that of the nearest frame which has one."""
    index = motion.segments.index(data.segment)
    turns, origins = np.array(motion.rotation[:, index]), np.array(motion.origin[:, index])
    if not motion.answered[data.frames[0], index]:
        turns[data.frames[0]], origins[data.frames[0]] = rotation, origin
    there = np.flatnonzero(np.isfinite(turns).all((1, 2)))
    nearest = there[np.abs(np.arange(len(turns))[:, None] - there).argmin(1)]
    return turns[nearest], origins[nearest]


def _shape(data: ClusterData, places: Floats, rotation: Floats, origin: Floats, noise_m: float) -> Shape:
    """Gather what is seen of one bone; all its markers count alike at first."""
    used: Mask = np.asarray(np.isfinite(data.points).all(-1) & np.isfinite(places).all(-1))
    shape = Shape(
        np.where(used[..., None], places, 0.0), np.where(used[..., None], data.points, 0.0), used,
        np.ones(len(data.labels)),
    )  # fmt: skip
    off = marker_residuals(shape, rotation, origin)[used]
    size = np.sqrt((off**2).mean()) if len(off) else 0.0
    return shape._replace(sd=np.full(len(data.labels), max(float(size), noise_m, _LEAST_SD)))


def _between(data: Sequence[ClusterData], known: tuple[Floats, Floats], ends: tuple[int, int]) -> tuple[Floats, Floats]:
    """Give the middle between two clusters in the first known posture, in the parent and in the child."""
    rotation, origin = known[0][0], known[1][0]
    middles = [rotation[s] @ data[s].reference.mean(0) + origin[s] for s in ends]
    middle = 0.5 * (middles[0] + middles[1])
    parent, child = ends
    return rotation[parent].T @ (middle - origin[parent]), rotation[child].T @ (middle - origin[child])


def _joint_start(
    joint: ChainJoint, ends: tuple[int, int], middle: tuple[Floats, Floats], known: tuple[Floats, Floats],
    rotation: Floats, origin: Floats,
) -> JointPlace:  # fmt: skip
    """Find where a joint is from bones that move freely: the point that moves least in both, the axes of most turn."""
    parent, child = ends
    neutral = known[0][0, parent].T @ known[0][0, child]
    inverse = np.swapaxes(rotation[:, parent], 1, 2)
    relative = inverse @ rotation[:, child]
    between = (inverse @ (origin[:, child] - origin[:, parent])[..., None])[..., 0]
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
        held = np.linalg.eigh(moves.T @ moves)[1][:, : joint.held_shifts].T
    return JointPlace(at[:3], at[3:], axis, second / np.linalg.norm(second), held[: joint.held_shifts], neutral)


def _still_point(relative: Floats, between: Floats, near: Floats) -> Floats:
    """Find the point (6,) of parent and child whose two places lie nearest to each other, not far from a guess."""
    rows = np.concatenate([np.broadcast_to(-np.eye(3), relative.shape), relative], -1)
    system = np.einsum("fia,fib->ab", rows, rows)
    # A hundredth of a frame's word keeps it in place along an axis about which everything turns.
    hold = 1e-2 * np.eye(6)
    return np.linalg.solve(system + hold, hold @ near - np.einsum("fia,fi->a", rows, between))


def _prior_sd(joint: ChainJoint, frames: int, sightings: int) -> Floats:
    """Give how far a joint's parameters (10,) may be from their start, in a sum over all frames and markers."""
    worth = sightings / _HINGE_SIGHTINGS if joint.held_turns == 2 else frames / _TRIAL_FRAMES
    return np.array([_REACH] * 6 + [np.pi] * 4) / np.sqrt(max(1.0, worth))


def _estimated(joint: ChainJoint) -> Mask:
    """Tell which of a joint's parameters (10,) are estimated."""
    centre = joint.held_shifts > 0 and joint.centre is None
    first, second = joint.held_turns in (1, 2) and joint.axis is None, joint.held_turns == 1
    return np.array([centre] * 6 + [first] * 2 + [second] * 2, bool)


def _hold(chain: Chain, slack: float) -> Chain:
    """Hold fast joints a tenth as wide as the best marker is off, and no wider than fits real ones; or looser."""
    best = min(float(shape.sd.min()) for shape in chain.shapes)
    return replace(chain, fast_m=slack * min(FAST_M, 0.1 * best))


def _weighed(chain: Chain, state: State, step: Step) -> tuple[Shape, ...]:
    """Give each marker the standard deviation that its residuals have, what it draws the bone itself allowed for.

    It is drawn towards that of its cluster as much as one frame counts.
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
        shapes.append(shape._replace(sd=np.maximum(sd, _LEAST_SD)))
    return tuple(shapes)


def _moving_together(chain: Chain, state: State, covariance: Floats, noise_m: float) -> Floats:
    """Give what skin that moves with its whole segment adds to the covariance (F, 6 S, 6 S) of the poses.

    Ours: residuals do not show it, so it is taken to be as large as what they show beyond the measurement's noise: all
    markers of a segment together then say no more of the bone than one does.
    """
    information = np.zeros_like(covariance)
    for s, shape in enumerate(chain.shapes):
        at = slice(6 * s, 6 * s + 6)
        skin = np.sqrt(np.maximum(1 - (noise_m / shape.sd) ** 2, 0.0)) / shape.sd
        rows = (marker_rows(shape, state.rotation[:, s]) * skin[:, None, None]).reshape(len(covariance), -1, 6)
        information[:, at, at] = shape.used.sum(1)[:, None, None] * (np.swapaxes(rows, 1, 2) @ rows)
    return np.asarray(covariance @ information @ covariance)


def _result(data: Sequence[ClusterData], chain: Chain, state: State, noise: Floats, skin: Floats) -> GlobalOptimisation:
    """Give the bones with both parts of their covariance; those that nothing fixes are NaN."""
    count, segments = state.rotation.shape[:2]
    blocks = [part.reshape(count, segments, 6, segments, 6) for part in (noise, noise + skin)]
    alone, covariance = (np.stack([b[:, s, :, s] for s in range(segments)], 1) for b in blocks)
    variance = np.diagonal(alone, axis1=-2, axis2=-1)
    open_ = ~np.asarray(((variance >= 0) & (variance <= _OPEN**2)).all(-1))
    notes = [note for d in data for note in d.notes]
    for d, lost in zip(data, open_.T, strict=True):
        if lost.any():
            notes.append(f"{d.segment}: {int(lost.sum())} of {count} frames have no answer: too few markers.")
    bones = BoneMotion(
        segments=tuple(d.segment for d in data),
        rotation=np.where(open_[..., None, None], np.nan, state.rotation),
        origin=np.where(open_[..., None], np.nan, state.origin),
        covariance=np.where(open_[..., None, None], np.nan, covariance), notes=tuple(notes),
    )  # fmt: skip
    return GlobalOptimisation(
        bones=bones, joints=chain.joints,
        centres_in_parent=np.stack([j.in_parent for j in state.joints]),
        centres_in_child=np.stack([j.in_child for j in state.joints]),
        axes=np.stack([j.axis for j in state.joints]), marker_sd=tuple(shape.sd for shape in chain.shapes),
    )  # fmt: skip
