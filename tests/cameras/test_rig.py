import numpy as np
import pytest

from marey.cameras.rig import Rig
from marey.errors import SettingProblem
from marey.geometry.rigid import RigidTransform


def test_a_rig_gives_its_cameras_by_name(make_camera):
    rig = Rig(tuple(make_camera(name=name) for name in ("left", "middle", "right")))
    assert rig.names == ("left", "middle", "right")
    assert rig["middle"].name == "middle"
    assert rig.subset(["right", "left"]).names == ("left", "right")
    assert len(rig) == 3
    assert rig.packed.shape[0] == 3


def test_the_error_on_an_unknown_name_lists_the_known_ones(make_camera):
    rig = Rig((make_camera(name="left"), make_camera(name="right")))
    with pytest.raises(SettingProblem, match=r"no camera 'top'\. The cameras are: left, right"):
        rig.subset(["left", "top"])
    with pytest.raises(SettingProblem, match="no camera 'top'"):
        rig["top"]


def test_names_are_unique_and_there_is_a_camera(make_camera):
    with pytest.raises(SettingProblem, match="Two cameras are called 'left'"):
        Rig((make_camera(name="left"), make_camera(name="left")))
    with pytest.raises(SettingProblem, match="at least one"):
        Rig(())


def test_a_rig_moves_and_shrinks_as_one(make_camera):
    rig = Rig((make_camera(name="left"), make_camera(name="right")))
    up = RigidTransform(np.diag([1.0, -1, -1]), np.array([0, 0, 1.0]))
    assert np.allclose(rig.moved(up).centres, up.apply(rig.centres))
    assert [camera.size for camera in rig.scaled(0.5)] == [(320, 240)] * 2
