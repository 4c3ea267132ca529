import re
from dataclasses import replace

import numpy as np
import pytest
from tests import worlds
from tests.takes import small_take

from marey.cameras.camera import Camera
from marey.motion.motion import LOST, BodyMotion
from marey.pipelines.consistency.one_direction import one_direction_reasons


@pytest.fixture
def motion(rng: np.random.Generator) -> BodyMotion:
    """A motion about the origin of the world."""
    made, _ = small_take(rng)
    return replace(made, joint_centres=0.1 * np.tanh(made.joint_centres))


def around(*bearings: float) -> list[Camera]:
    """Cameras that look at the origin from some directions [deg]."""
    found = []
    for number, bearing in enumerate(np.deg2rad(bearings)):
        centre = 4.0 * np.array([np.cos(bearing), np.sin(bearing), 0.0])
        found.append(worlds.looking_at(np.zeros(3), centre, name=f"cam{number + 1:02d}"))
    return found


@pytest.mark.parametrize("bearings", [(0, 90), (0, 60), (0, 180, 90), (0, 120)])
def test_cameras_at_the_side_determine_the_depth(motion, bearings):
    assert list(one_direction_reasons(motion, around(*bearings))) == []


@pytest.mark.parametrize(
    ("bearings", "how", "angle"),
    [
        ((0, 180), "nearly face each other", 180),
        ((0, 150), "nearly face each other", 150),
        ((10, 40), "from nearly the same direction", 30),
        ((0, 170, 20), "from one side or from opposite sides", 30),
    ],
)
def test_cameras_on_one_line_are_named_with_their_angle(motion, bearings, how, angle):
    [reason] = one_direction_reasons(motion, around(*bearings))
    assert (reason.level, reason.cause) == ("usable with limits", "one direction")
    assert how in reason.what
    # The joints lie up to 0.1 m beside the origin, 4 m away.
    [stated] = re.findall(r"(\d+) degrees", reason.what)
    assert float(stated) == pytest.approx(angle, abs=2)
    assert len(reason.cameras) == len(bearings)


def test_without_a_pose_nothing_is_stated(motion):
    lost = replace(motion, state=np.full(len(motion), LOST))
    assert list(one_direction_reasons(lost, around(0, 180))) == []
