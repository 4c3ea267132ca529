"""How much a joint gives: the turns and shifts that it makes little of, as standard deviations between two instants."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats

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
