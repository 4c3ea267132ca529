"""The transfer of a motion to another character."""

import pytest
from tests import performer, rigs
from tests.io.gltf.test_rig import segments

from marey.errors import FileProblem
from marey.io.npz import write_motion
from marey.pipelines.capture.motion import Motion, load_motion
from marey.pipelines.retarget import copy_beside, retarget


@pytest.fixture
def folder(tmp_path):
    write_motion(tmp_path / "motion.npz", performer.motion(performer.body()))
    rigs.write_rig(tmp_path / "knight.glb", rigs.MIXAMO, segments(rigs.MIXAMO), unit=0.01)
    return tmp_path


def test_a_motion_is_transferred_and_saved_by_its_result(folder):
    moved = retarget(load_motion(folder), folder / "knight.glb")
    assert moved.joints["left_thigh"] == "mixamorig:LeftUpLeg"
    assert moved.guessed == ()
    [reason] = moved.verdict.reasons
    assert reason.what.startswith("There is no result at")
    assert len(moved.gaps) == 1
    path = moved.save(folder / "new" / "copy.glb")
    assert rigs.open_glb(path)[0]["animations"][0]["name"] == "marey"
    assert repr(moved).startswith("Motion on knight.glb\n  keys")


def test_a_motion_in_memory_needs_no_folder(folder):
    data = performer.motion(performer.body())
    assert retarget(Motion(data), folder / "knight.glb").gaps


def test_a_motion_without_gaps_on_known_joints_is_good(folder):
    data = performer.motion(performer.body())
    assert retarget(Motion(data.frames(data.answered)), folder / "knight.glb").verdict.level == "good"


@pytest.mark.parametrize(("name", "wrong"), [("a.fbx", "has the suffix .fbx"), ("knight.glb", "the character itself")])
def test_a_copy_that_cannot_be_written_is_rejected(folder, name, wrong):
    with pytest.raises(FileProblem, match=wrong):
        retarget(folder, folder / "knight.glb").save(folder / name)


def test_the_copy_is_beside_the_motion_by_default(folder):
    assert copy_beside(folder, folder / "knight.glb") == folder / "knight_retargeted.glb"
