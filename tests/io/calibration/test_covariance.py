"""The covariance of cameras in calibration.json."""

import json

import numpy as np
import pytest
from tests import worlds

from marey.cameras.parameters import PARAMETER_NAMES
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.io.calibration.covariance import read_camera_covariance

RIG = Rig(worlds.ring())
NAMES = [f"{name}.{key}" for name in RIG.names for key in PARAMETER_NAMES]
VALUES = np.diag(np.arange(1.0, 61.0))


def written(folder, **changes):
    content = {
        "together": True,
        "cameras": {camera.name: {"lens": {"fx": {"value": camera.matrix[0, 0]}}} for camera in RIG},
        "covariance": {"parameters": NAMES, "matrix": VALUES.tolist()},
    }
    (folder / "calibration.json").write_text(json.dumps(content | changes))
    return folder / "cameras.toml"


def test_the_covariance_is_that_of_the_cameras_in_their_order(tmp_path):
    path = written(tmp_path)
    np.testing.assert_array_equal(read_camera_covariance(path, RIG), VALUES)
    two = Rig((RIG.cameras[2], RIG.cameras[0]))
    np.testing.assert_array_equal(np.diag(read_camera_covariance(path, two)), [*range(31, 46), *range(1, 16)])


def test_without_the_file_or_poses_nothing_is_known(tmp_path):
    assert read_camera_covariance(tmp_path / "cameras.toml", RIG) is None
    assert read_camera_covariance(written(tmp_path, together=False), RIG) is None
    assert read_camera_covariance(written(tmp_path, covariance=None), RIG) is None
    other = Rig((*RIG.cameras, worlds.looking_at(np.zeros(3), np.array([2.0, 1, 0]), name="more")))
    assert read_camera_covariance(written(tmp_path), other) is None


@pytest.mark.parametrize(
    ("changes", "wrong"),
    [
        ({"covariance": {"parameters": NAMES, "matrix": [[1.0]]}}, "size is not that of its parameters"),
        ({"covariance": {"parameters": NAMES}}, "is not a calibration of marey"),
        ({"cameras": {name: {"lens": {"fx": {"value": 1.0}}} for name in RIG.names}}, "another focal length of 'cam"),
    ],
)
def test_a_file_of_other_cameras_is_named(tmp_path, changes, wrong):
    with pytest.raises(FileProblem, match=wrong):
        read_camera_covariance(written(tmp_path, **changes), RIG)


def test_a_file_that_is_not_json_is_named(tmp_path):
    (tmp_path / "calibration.json").write_text("{")
    with pytest.raises(FileProblem, match=r"calibration\.json"):
        read_camera_covariance(tmp_path / "cameras.toml", RIG)
