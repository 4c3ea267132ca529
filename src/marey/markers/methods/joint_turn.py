"""Rotation of a joint about one axis: one angle per frame, independent of the axes of the bones' frames."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.geometry import rotations
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.problem import MarkerProblem

_LEAST_TURN = np.radians(2)
"""Postures less than this rotation apart [rad] do not determine an axis. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class JointTurn:
    """The rotation of one joint about one axis, relative to the first known posture."""

    turn: Floats
    """(F,) [rad]; NaN where a bone has no pose."""
    at_postures: Floats
    """(K,) in the known postures [rad]; the first is 0."""

    @property
    def between_postures(self) -> float:
        """Largest rotation between known postures [rad]."""
        return float(np.ptp(self.at_postures))

    @property
    def range(self) -> float:
        """Range of the rotation over the trial [rad]; 0 without a pose."""
        answered = self.turn[np.isfinite(self.turn)]
        return float(np.ptp(answered)) if len(answered) else 0.0


@dataclass(frozen=True, eq=False, kw_only=True)
class JointAxis:
    """The axis about which a joint's rotation is measured, and its zero."""

    parent: str | None
    """Parent segment; None for the laboratory."""
    child: str
    base: Floats
    """(3, 3) parent from child at zero rotation: in the first known posture."""
    axis: Floats
    """(3,) unit vector in the child's frame."""

    def turn(self, rotation: Floats, segments: tuple[str, ...]) -> Floats:
        """Return the rotation angle (N,) [rad] in N poses (N, S, 3, 3) of these segments."""
        relative = _relative(rotation, segments, self.parent, self.child)
        return np.asarray(rotations.log(self.base.T @ relative) @ self.axis)


def segment_turn(problem: MarkerProblem, motion: BoneMotion, segment: str) -> JointTurn | None:
    """Return the rotation of a segment's joint about the axis of `segment_axis`; None if no joint rotates."""
    axis = segment_axis(problem, motion, segment)
    return None if axis is None else turn_about(axis, problem, motion)


def segment_axis(
    problem: MarkerProblem, motion: BoneMotion, segment: str, *, locked: tuple[tuple[str, str], ...] = ()
) -> JointAxis | None:
    """Choose the joint of a segment whose known postures are farthest apart, or that rotates most.

    Its axis is that of the rotation from the first posture to the posture farthest from it; with one posture, or equal
    postures, it is the axis about which the joint rotates most over the trial. For a segment without a joint, the
    rotation in the laboratory is used.

    Args:
        problem: The trial.
        motion: Current estimate of the bones.
        segment: The segment.
        locked: Joints that are excluded.

    Returns:
        The axis; None if no joint rotates.
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
    """Return the rotation of one joint about the axis of `joint_axis`."""
    return turn_about(joint_axis(problem, motion, parent, child), problem, motion)


def joint_axis(problem: MarkerProblem, motion: BoneMotion, parent: str | None, child: str) -> JointAxis:
    """Return the axis of one joint as `segment_axis` describes it; a parent of None is the laboratory."""
    at_postures = _relative(problem.calibration.rotation, problem.calibration.segments, parent, child)
    out_of_first = rotations.log(at_postures[0].T @ at_postures)
    length = np.linalg.norm(out_of_first, axis=-1)
    if length.max() > _LEAST_TURN:
        axis = out_of_first[length.argmax()]
    else:
        axis = _main_axis(rotations.log(at_postures[0].T @ _relative(motion.rotation, motion.segments, parent, child)))
    return JointAxis(parent=parent, child=child, base=at_postures[0], axis=axis / np.linalg.norm(axis))


def turn_about(axis: JointAxis, problem: MarkerProblem, motion: BoneMotion) -> JointTurn:
    """Measure a joint's rotation over the trial and in its known postures."""
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
    """Return the main direction (3,) of rotation vectors (F, 3), with the sign of the longest component along it."""
    answered = vectors[np.isfinite(vectors).all(-1)]
    if not len(answered):
        return np.array([1.0, 0.0, 0.0])
    axis = np.linalg.eigh(answered.T @ answered)[1][:, 2]
    along = answered @ axis
    return np.asarray(axis * (np.sign(along[np.argmax(np.abs(along))]) or 1.0))
