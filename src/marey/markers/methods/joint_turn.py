"""How far a joint is turned between its known postures: one number a frame, whatever axes the bones' frames have."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.geometry import rotations
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.problem import MarkerProblem

_LEAST_TURN = np.radians(2)  # postures less than this apart do not name an axis


@dataclass(frozen=True, eq=False, kw_only=True)
class JointTurn:
    """The turn of one joint about one axis, out of the first known posture."""

    turn: Floats
    """(F,) [rad]; NaN where a bone has no answer."""
    at_postures: Floats
    """(K,) in the known postures [rad]; the first is 0."""

    @property
    def between_postures(self) -> float:
        """How far the known postures lie apart [rad]."""
        return float(np.ptp(self.at_postures))

    @property
    def range(self) -> float:
        """How far the joint turns over the trial [rad]; 0 without an answer."""
        answered = self.turn[np.isfinite(self.turn)]
        return float(np.ptp(answered)) if len(answered) else 0.0


@dataclass(frozen=True, eq=False, kw_only=True)
class JointAxis:
    """The axis about which a joint's turn is counted, and where the turn is 0."""

    parent: str | None
    """None is the laboratory."""
    child: str
    base: Floats
    """(3, 3) parent from child where the turn is 0: in the first known posture."""
    axis: Floats
    """(3,) of length 1, in the child."""

    def turn(self, rotation: Floats, segments: tuple[str, ...]) -> Floats:
        """Give the turn (N,) [rad] in N poses (N, S, 3, 3) of these segments."""
        relative = _relative(rotation, segments, self.parent, self.child)
        return np.asarray(rotations.log(self.base.T @ relative) @ self.axis)


def segment_turn(problem: MarkerProblem, motion: BoneMotion, segment: str) -> JointTurn | None:
    """Give the turn of a segment's joint about its axis, as `segment_axis` chooses it; None where nothing turns."""
    axis = segment_axis(problem, motion, segment)
    return None if axis is None else turn_about(axis, problem, motion)


def segment_axis(
    problem: MarkerProblem, motion: BoneMotion, segment: str, *, locked: tuple[tuple[str, str], ...] = ()
) -> JointAxis | None:
    """Choose that joint of a segment whose known postures lie farthest apart, or that turns most.

    Its axis leads from the first posture to the posture farthest from it; with one posture, or postures alike, it is
    the axis about which the joint turns most over the trial. A segment without a joint turns in the laboratory.

    Args:
        problem: The trial.
        motion: The bones as known so far.
        segment: The segment whose markers are looked at.
        locked: Joints that do not come into question.

    Returns:
        The axis; None where nothing turns.
    """
    joints: list[tuple[str | None, str]] = [
        pair for pair in problem.joints if segment in pair and pair not in locked and set(pair) <= set(motion.segments)
    ]
    axes = [joint_axis(problem, motion, *pair) for pair in joints or [(None, segment)]]
    turns = [turn_about(axis, problem, motion) for axis in axes]
    order = [(t.between_postures > _LEAST_TURN, t.between_postures, t.range) for t in turns]
    best = max(range(len(axes)), key=lambda index: order[index])
    return axes[best] if max(order[best][1:]) > _LEAST_TURN else None


def joint_turn(problem: MarkerProblem, motion: BoneMotion, parent: str | None, child: str) -> JointTurn:
    """Give the turn of one joint about its axis, as `joint_axis` chooses it."""
    return turn_about(joint_axis(problem, motion, parent, child), problem, motion)


def joint_axis(problem: MarkerProblem, motion: BoneMotion, parent: str | None, child: str) -> JointAxis:
    """Give the axis of one joint as `segment_axis` describes it; the parent None is the laboratory."""
    at_postures = _relative(problem.calibration.rotation, problem.calibration.segments, parent, child)
    out_of_first = rotations.log(at_postures[0].T @ at_postures)
    length = np.linalg.norm(out_of_first, axis=-1)
    if length.max() > _LEAST_TURN:
        axis = out_of_first[length.argmax()]
    else:
        axis = _main_axis(rotations.log(at_postures[0].T @ _relative(motion.rotation, motion.segments, parent, child)))
    return JointAxis(parent=parent, child=child, base=at_postures[0], axis=axis / np.linalg.norm(axis))


def turn_about(axis: JointAxis, problem: MarkerProblem, motion: BoneMotion) -> JointTurn:
    """Count a joint's turn over the trial and in its known postures."""
    return JointTurn(
        turn=axis.turn(motion.rotation, motion.segments),
        at_postures=axis.turn(problem.calibration.rotation, problem.calibration.segments),
    )


def _relative(rotation: Floats, segments: tuple[str, ...], parent: str | None, child: str) -> Floats:
    of_child = rotation[:, segments.index(child)]
    if parent is None:
        return of_child
    return np.asarray(np.swapaxes(rotation[:, segments.index(parent)], -1, -2) @ of_child)


def _main_axis(vectors: Floats) -> Floats:
    """Find the direction along which rotation vectors (F, 3) are longest, pointing to the longest one."""
    answered = vectors[np.isfinite(vectors).all(-1)]
    if not len(answered):
        return np.array([1.0, 0.0, 0.0])
    axis = np.linalg.eigh(answered.T @ answered)[1][:, 2]
    along = answered @ axis
    return np.asarray(axis * (np.sign(along[np.argmax(np.abs(along))]) or 1.0))
