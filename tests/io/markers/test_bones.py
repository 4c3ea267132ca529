"""Reading and writing `bones.npz`, and errors for inconsistent files."""

from dataclasses import replace

import numpy as np
import pytest

from marey.errors import FileProblem
from marey.geometry import rotations
from marey.io.markers.bones import BoneFile, read_bones, write_bones
from marey.io.npz import read_arrays, write_arrays
from marey.markers.data.bone_motion import BoneMotion


@pytest.fixture
def bones(rng) -> BoneFile:
    rotation, origin = rotations.exp(rng.normal(size=(6, 2, 3))), rng.normal(size=(6, 2, 3))
    spread = rng.uniform(0.001, 0.1, size=(6, 2, 6))
    rotation[3, 1], origin[3, 1], spread[3, 1] = np.nan, np.nan, np.nan
    motion = BoneMotion(
        segments=("thigh", "shank"), rotation=rotation, origin=origin, covariance=spread[..., None] ** 2 * np.eye(6)
    )
    return BoneFile(motion=motion, time=0.2 + np.arange(6) / 50, side="left")


def test_bones_are_read_as_written_with_gaps_and_standard_deviations(bones, tmp_path):
    write_bones(tmp_path / "bones.npz", bones)
    back = read_bones(tmp_path / "bones.npz")
    assert (back.motion.segments, back.side) == (("thigh", "shank"), "left")
    np.testing.assert_array_equal(back.time, bones.time)
    for name in ("rotation", "origin", "rotation_sd", "origin_sd"):
        np.testing.assert_allclose(getattr(back.motion, name), getattr(bones.motion, name), rtol=1e-12)


def test_the_covariance_of_rotation_and_translation_is_read_as_written(bones, tmp_path, rng):
    root = rng.normal(0, 0.01, (6, 2, 6, 6))
    motion = replace(bones.motion, covariance=root @ np.swapaxes(root, -1, -2))
    write_bones(tmp_path / "bones.npz", replace(bones, motion=motion))
    arrays = read_arrays(tmp_path / "bones.npz")
    np.testing.assert_allclose(arrays["thigh_covariance"][:, 0, 3], 1e3 * motion.covariance[:, 0, 0, 3])
    np.testing.assert_allclose(read_bones(tmp_path / "bones.npz").motion.covariance, motion.covariance, rtol=1e-9)


def test_translations_are_in_millimetres_and_rotations_in_radians(bones, tmp_path):
    write_bones(tmp_path / "bones.npz", bones)
    arrays = read_arrays(tmp_path / "bones.npz")
    np.testing.assert_allclose(arrays["thigh_origin"], 1e3 * bones.motion.origin[:, 0])
    np.testing.assert_allclose(arrays["shank_rotation_sd"], bones.motion.rotation_sd[:, 1])
    np.testing.assert_allclose(arrays["shank_origin_sd"], 1e3 * bones.motion.origin_sd[:, 1])
    assert arrays["rate"] == pytest.approx(50)


def test_standard_deviations_are_unknown_if_the_file_has_none(tmp_path):
    arrays = {"a_rotation": np.tile(np.eye(3), (4, 1, 1)), "a_origin": np.zeros((4, 3)), "rate": 20.0}
    write_arrays(tmp_path / "truth.npz", arrays)
    back = read_bones(tmp_path / "truth.npz")
    assert np.isnan(back.motion.rotation_sd).all()
    np.testing.assert_allclose(back.time, np.arange(4) / 20)


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        ({"rate": None}, "neither `time` nor `rate`"),
        ({"a_origin": np.zeros((3, 3))}, "a_origin of shape"),
        ({"a_origin": None}, "a_origin of shape"),
        ({"a_rotation": None}, "has no array NAME_rotation"),
    ],
)
def test_an_inconsistent_file_is_an_error_that_states_the_problem(tmp_path, change, wrong):
    arrays = {"a_rotation": np.tile(np.eye(3), (4, 1, 1)), "a_origin": np.zeros((4, 3)), "rate": 20.0}
    arrays = {k: v for k, v in (arrays | change).items() if v is not None}
    write_arrays(tmp_path / "bones.npz", arrays)
    with pytest.raises(FileProblem, match=wrong):
        read_bones(tmp_path / "bones.npz")
