"""How far a joint is turned between its known postures: one number a frame, whatever axes the bones' frames have."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.geometry import rotations
from marey.markers.bone_motion import BoneMotion
from marey.markers.problem import MarkerProblem

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


def segment_turn(problem: MarkerProblem, motion: BoneMotion, segment: str) -> JointTurn | None:
    """Give the turn of that joint of a segment whose known postures lie farthest apart, or that turns most.

    It is the turn about the axis that leads from the first posture to the posture farthest from it; with one posture,
    or postures alike, the axis about which the joint turns most over the trial. Of a segment without a joint it is
    the segment's own turn in the laboratory.

    Args:
        problem: The trial.
        motion: The bones as known so far.
        segment: The segment whose markers are looked at.

    Returns:
        The turn; None where nothing turns.
    """
    joints: list[tuple[str | None, str]] = [pair for pair in problem.joints if segment in pair]
    turns = [joint_turn(problem, motion, *pair) for pair in joints or [(None, segment)]]
    best = max(turns, key=lambda turn: (turn.between_postures > _LEAST_TURN, turn.between_postures, turn.range))
    return best if max(best.between_postures, best.range) > _LEAST_TURN else None


def joint_turn(problem: MarkerProblem, motion: BoneMotion, parent: str | None, child: str) -> JointTurn:
    """Give the turn of one joint as `segment_turn` describes it; the parent None is the laboratory."""
    at_postures = _relative(problem.calibration.rotation, problem.calibration.segments, parent, child)
    over_trial = _relative(motion.rotation, motion.segments, parent, child)
    out_of_first = rotations.log(at_postures[0].T @ at_postures)
    vectors = rotations.log(at_postures[0].T @ over_trial)
    length = np.linalg.norm(out_of_first, axis=-1)
    axis = out_of_first[length.argmax()] if length.max() > _LEAST_TURN else _main_axis(vectors)
    axis = axis / np.linalg.norm(axis)
    return JointTurn(turn=vectors @ axis, at_postures=out_of_first @ axis)


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
