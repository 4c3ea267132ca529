import base64
import json
import re

import numpy as np
import pytest
from tests.made_animations import flexed
from tests.made_joints import made_joint

from marey.geometry import rotations
from marey.knee.motion.joint_motion import JointMotion, KneeMotion, joint_proximities, joint_sides
from marey.knee.space.structures import BONE_OF_CARTILAGE
from marey.markers.kinematics.transform_chain import CAPTURE_GLOBAL, MR_ANATOMIC, MR_GLOBAL, NamedTransform
from marey.view.pages.knee_report import KneeReport, distances_of, knee_html
from marey.view.pictures.knee_picture import DrawnPart

TURN = rotations.exp(np.array([0.0, 0.0, 0.8]))


@pytest.fixture(scope="module")
def report() -> KneeReport:
    """A knee that bends in three frames and is lost in the second, before a room turned about the vertical."""
    bends = [flexed(20.0 * f) for f in range(3)]
    poses = {
        "femur": (np.array([TURN @ b.rotation for b in bends]), np.array([TURN @ b.translation for b in bends])),
        "tibia": (np.repeat(TURN[None], 3, 0), np.zeros((3, 3))),
    }
    poses["femur"][0][1] = np.nan
    named = {
        frame: {
            bone: NamedTransform(to=CAPTURE_GLOBAL, from_=frame, rotation=turn, translation=place)
            for bone, (turn, place) in poses.items()
        }
        for frame in (MR_GLOBAL, MR_ANATOMIC)
    }
    motion = JointMotion(time=np.arange(3) / 10, left=False, poses=named[MR_GLOBAL], anatomical=named[MR_ANATOMIC])
    parts = made_joint(fine=2)
    sides, _ = joint_sides(parts, ["femur", "tibia"], left=False)
    drawn = {
        name: DrawnPart(bone=BONE_OF_CARTILAGE.get(name, name), surface=part, cartilage=name in BONE_OF_CARTILAGE)
        for name, part in parts.items()
    }
    found = KneeMotion(method="<skin>", motion=motion, joints=joint_proximities(motion, sides), angles=None)
    return KneeReport(title="a & b", parts=drawn, found=found, carried=("patella",))


def data_of(page: str) -> dict:
    return json.loads(re.search(r'application/json">(.*?)</script>', page, re.S)[1])  # type: ignore[index]


def unpacked(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind)


def test_the_page_contains_the_poses_meshes_and_gaps(report):
    knee = data_of(knee_html(report))["knee"]
    femur = unpacked(knee["motions"][0]["poses"]["femur"], "<f4").reshape(3, 3, 4)
    np.testing.assert_allclose(femur[2, :, :3], TURN @ flexed(40.0).rotation, atol=1e-6)
    assert np.isnan(femur[1]).any()
    part = next(part for part in knee["parts"] if part["name"] == "tibia")
    places = unpacked(part["places"], "<u2").reshape(-1, 3) * part["step"] + part["low"]
    np.testing.assert_allclose(places, report.parts["tibia"].surface.vertices_mm, atol=part["step"])
    patella = next(part for part in knee["parts"] if part["name"] == "patella")
    assert patella["shown"] is False


def test_distances_are_coded_from_overlap_to_the_limit(report):
    knee = data_of(knee_html(report))["knee"]
    part = next(part for part in knee["parts"] if part["name"] == "tibial_cartilage")
    found = distances_of("tibial_cartilage", report.found)
    assert found is not None
    vertices, distance = found
    codes = unpacked(part["maps"][0], "u1").reshape(distance.shape)
    np.testing.assert_array_equal(unpacked(part["sources"], "<u4"), vertices)
    assert (codes[1] == 0).all()
    near = np.nan_to_num(distance[0], nan=9.0) < 5.0
    assert (codes[0][~near] == 0).all()
    np.testing.assert_allclose((codes[0][near] - 2) / 253 * 5.0, distance[0][near], atol=5.0 / 253)


def test_the_eye_stands_before_the_knee_in_the_room(report):
    # In the scanner the front is at -y, where the eye of turn 0 stands; the room is turned by 0.8 about the vertical.
    assert data_of(knee_html(report))["knee"]["heading"] == pytest.approx(0.8)


def test_texts_are_written_as_texts(report):
    page = knee_html(report)
    assert "a &amp; b" in page
    assert "<skin>" not in page
