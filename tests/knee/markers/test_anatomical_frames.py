from dataclasses import replace

import numpy as np
import pytest
import trimesh
from tests.made_scans import BALLS, made_bones

from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.knee.markers.anatomical_frames import Landmarks, bone_frame, principal_frame
from marey.knee.space.surface import TriangleSurface
from marey.markers.kinematics.transform_chain import MR_ANATOMIC, MR_GLOBAL

BALLS_MM = np.array(BALLS["femur"])


def made_femur(shaft_mm: float, *, turn: float = 0.0) -> TriangleSurface:
    """Two spheres of 22 mm as condyles, 46 mm apart, and a shaft up from between their fronts."""
    balls = [trimesh.creation.icosphere(subdivisions=4, radius=22.0) for _ in range(2)]
    balls[0].apply_translation([-23, 0, 0])
    balls[1].apply_translation([23, 0, 0])
    shaft = trimesh.creation.cylinder(radius=14, height=shaft_mm, sections=48).subdivide_to_size(6.0)
    shaft.apply_translation([0, -8, shaft_mm / 2])
    whole = trimesh.util.concatenate([*balls, shaft])
    motion = RigidTransform.from_vector(np.radians(turn) * np.array([0.2, 0.3, 0.9]), np.array([5.0, -7, 3]))
    return TriangleSurface(vertices_mm=motion.apply(np.asarray(whole.vertices)), faces=np.asarray(whole.faces))


def test_a_femurs_frame_lies_between_its_condyles_with_their_axis_to_the_right():
    for turn in (0.0, 12.0):
        found = bone_frame("femur", made_femur(220.0, turn=turn), BALLS_MM, left=False)
        motion = RigidTransform.from_vector(np.radians(turn) * np.array([0.2, 0.3, 0.9]), np.array([5.0, -7, 3]))
        assert found.source == "the bone's form"
        assert found.notes == ()
        assert found.scanner_from_bone.translation == pytest.approx(motion.translation, abs=0.3)
        z, y = found.scanner_from_bone.rotation[:, 2], found.scanner_from_bone.rotation[:, 1]
        assert np.degrees(np.arccos(z @ motion.rotation @ [-1.0, 0, 0])) < 0.5
        assert np.degrees(np.arccos(y @ motion.rotation @ [0.0, 0, 1])) < 2.0


def test_with_a_short_shaft_the_scanners_axis_is_used_and_reported():
    found = bone_frame("femur", made_femur(60.0), BALLS_MM, left=False)
    assert "its shaft is too short" in found.notes[0]
    assert found.scanner_from_bone.rotation[:, 1] == pytest.approx([0, 0, 1], abs=0.02)


def test_the_step_takes_the_scanners_points_into_the_bones_frame():
    found = bone_frame("tibia", made_bones()["tibia"], BALLS_MM, left=False)
    assert (found.step.to, found.step.from_) == (MR_ANATOMIC, MR_GLOBAL)
    assert found.step.covariance is None
    there = found.scanner_from_bone.apply(np.eye(3))
    assert found.step.apply(there) == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(found.scanner_from_bone.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("left", [True, False])
def test_landmarks_give_axes_that_point_anterior_proximal_and_to_the_right(left):
    medial, lateral = ([-40.0, 0, 0], [40.0, 0, 0]) if left else ([40.0, 0, 0], [-40.0, 0, 0])
    side = "left_" if left else "right_"
    places = {f"{side}ME": medial, f"{side}LE": lateral, f"{side}FS": [0.0, 0, 120]}
    found = bone_frame("femur", None, BALLS_MM, left=left, landmarks=Landmarks(places_mm=places))
    assert found.source == "landmarks"
    assert pytest.approx(np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])) == found.scanner_from_bone.rotation.T
    tibia = Landmarks(places_mm={"MC": medial, "LC": lateral, "MM": [1.0, 0, -300], "LM": [-1.0, 0, -300]})
    found = bone_frame("tibia", None, BALLS_MM, left=left, landmarks=tibia)
    assert found.scanner_from_bone.rotation[:, 1] == pytest.approx([0, 0, 1])


def test_missing_landmarks_are_named_and_the_next_best_is_taken():
    found = bone_frame("femur", None, BALLS_MM, left=True, landmarks=Landmarks(places_mm={"ME": [1.0, 2, 3]}))
    assert "LE, FS or HJC" in found.notes[0]
    assert "principal axes" in found.source


def test_principal_axes_turn_with_the_points_they_are_of(rng):
    frame, _ = principal_frame(BALLS_MM)
    assert frame.translation == pytest.approx(BALLS_MM.mean(0))
    for _ in range(20):
        motion = RigidTransform.from_vector(rng.normal(size=3) * 2, rng.normal(0, 100, 3))
        moved, _ = principal_frame(motion.apply(BALLS_MM))
        assert (motion @ frame).matrix == pytest.approx(moved.matrix, abs=1e-9)
    inside = frame.inverse().apply(BALLS_MM)
    assert (inside**2).sum(0) == pytest.approx(np.sort((inside**2).sum(0))[::-1])
    assert np.abs(inside.T @ inside - np.diag((inside**2).sum(0))).max() < 1e-8


def test_axes_that_small_errors_rotate_are_reported(rng):
    square = np.array([[30.0, 0, 0], [0, 30, 0], [-30, 0, 0], [0, -30, 0]])
    _, notes = principal_frame(square)
    assert any("longest and middle" in note for note in notes)
    assert any("reach equally far to both sides" in note for note in notes)
    assert principal_frame(np.array([[60.0, 5, 0], [-20, -10, 3], [-25, 12, -8], [-15, -7, 20]]))[1] == ()


def test_a_bone_whose_condyles_are_not_visible_is_reported_and_gets_another_frame():
    bone = made_femur(220.0)
    cut = bone.faces[(bone.vertices_mm[bone.faces][:, :, 2] > 40).all(1)]
    used = np.unique(cut)
    shaft = TriangleSurface(vertices_mm=bone.vertices_mm[used], faces=np.searchsorted(used, cut))
    found = bone_frame("femur", replace(shaft), BALLS_MM, left=False)
    assert "principal axes" in found.source
    assert any("condyles" in note for note in found.notes)
    assert rotations.log(found.scanner_from_bone.rotation).shape == (3,)
