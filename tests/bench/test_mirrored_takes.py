"""A take in a mirror has the images of the mirrored world."""

import numpy as np
import pytest
from bench.common.mirrored_takes import mirrored_camera, mirrored_truth

from marey.cameras.camera import Camera
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform


@pytest.fixture
def camera():
    return Camera(
        name="cam01", size=(640, 480), matrix=np.array([[800.0, 0, 310], [0, 790, 250], [0, 0, 1]]),
        distortion=np.array([-0.1, 0.02, 0.003, -0.002, 0.001]),
        camera_from_world=RigidTransform(rotations.exp(np.array([1.5, 0.2, -0.1])), np.array([0.1, 0.4, 3.0])),
    )  # fmt: skip


def test_mirrored_places_have_mirrored_images(camera, rng):
    places = rng.normal(size=(20, 3)) * 0.3
    other = mirrored_camera(camera)
    expected = camera.project(places) * [-1, 1] + [camera.width - 1, 0]
    np.testing.assert_allclose(other.project(places * [-1, 1, 1]), expected, atol=1e-9)
    again = mirrored_camera(other)
    np.testing.assert_allclose(again.project(places), camera.project(places), atol=1e-9)


def test_left_and_right_change_names_and_faces_keep_their_outside(rng):
    corners = rng.normal(size=(1, 3, 3))
    truth = {
        "joints": rng.normal(size=(1, 4, 3)), "joint_names": np.array(["l_hip", "r_hip", "lumbar", "pelvis"]),
        "vertices": corners, "faces": np.array([[0, 1, 2]]), "bone_rotation": rotations.exp(rng.normal(size=(1, 3, 3))),
        "limb_names": np.array(["LHipJoint", "LeftArm", "LowerBack"]), "rate": np.array(25),
    }  # fmt: skip
    found = mirrored_truth(truth)
    assert list(found["joint_names"]) == ["r_hip", "l_hip", "lumbar", "pelvis"]
    assert list(found["limb_names"]) == ["RHipJoint", "RightArm", "LowerBack"]

    def outward(given):
        a, b, c = given["vertices"][0, given["faces"][0]]
        return np.cross(b - a, c - a)

    np.testing.assert_allclose(outward(found), outward(truth) * [-1, 1, 1])
    np.testing.assert_allclose(np.linalg.det(found["bone_rotation"]), 1.0)
    np.testing.assert_allclose(mirrored_truth(found)["joints"], truth["joints"])
