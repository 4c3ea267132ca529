from dataclasses import replace

import numpy as np
import pytest
from tests.takes import rig, small_take

from marey.cameras.camera import Camera
from marey.motion.motion import LOST, BodyMotion
from marey.pipelines.consistency.cut_off import cut_off_reasons


@pytest.fixture
def motion(rng: np.random.Generator) -> BodyMotion:
    """A motion about a point in the middle of the images, the feet 1 m lower than the rest."""
    made, _ = small_take(rng)
    centres = np.where(np.isfinite(made.joint_centres), 0.1 * np.tanh(made.joint_centres), np.nan)
    low = np.array(["ankle" in name for name in made.joint_names])
    assert low.any()
    centres[:, low, 2] -= 1.0
    return replace(made, joint_centres=centres)


def cameras(*heights: int) -> list[Camera]:
    """Cameras with images of some heights, in which the feet are in row 90 to 110."""
    return [replace(each, size=(each.width, height)) for each, height in zip(rig(), heights, strict=True)]


def test_a_person_in_the_images_is_not_cut_off(motion):
    assert list(cut_off_reasons(motion, cameras(120, 120))) == []


def test_joints_that_one_camera_has_alone_are_named(motion):
    [reason] = cut_off_reasons(motion, cameras(120, 75))
    assert (reason.level, reason.cause) == ("usable with limits", "cut off")
    assert "at most one camera" in reason.what
    for name in motion.joint_names:
        assert (name.replace("_", " ") in reason.what) == ("ankle" in name)


def test_a_third_camera_is_enough(motion):
    third = replace(rig()["cam01"], name="cam03")
    assert list(cut_off_reasons(motion, [*cameras(120, 75), third])) == []
    [reason] = cut_off_reasons(motion, [*cameras(75, 75), third])
    assert reason.cause == "cut off"


def test_frames_without_a_pose_do_not_count(motion):
    assert list(cut_off_reasons(replace(motion, state=np.full(len(motion), LOST)), cameras(75, 75))) == []
    [reason] = cut_off_reasons(motion, cameras(75, 75))
    assert reason.level == "usable with limits"
