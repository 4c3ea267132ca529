"""Segments of a person on the bodies of a model: bodies, joint centres and anatomical axes."""

import numpy as np
import pytest
from tests import performer

from marey.body.articulation.jointed_kinematics import place
from marey.body.articulation.model_points import segment_body, segments_on_model, undriven_coordinates
from marey.body.articulation.model_scaling import model_joints, neutral_posture
from marey.io.axes import OPENSIM_FROM_WORLD
from marey.io.opensim.osim import write_osim
from marey.io.opensim.osim_model import read_osim_model
from marey.motion.anatomical import anatomy_of


@pytest.fixture
def model(tmp_path):
    write_osim(tmp_path / "body.osim", performer.body(), mass_kg=70.0)
    return read_osim_model(tmp_path / "body.osim")


def test_the_axes_of_legs_are_those_of_the_person_at_rest(model):
    person = performer.body()
    names = ("pelvis", "left_thigh", "right_shank", "left_foot", "right_foot")
    placed = place(model, neutral_posture(model))
    own = anatomy_of(person.skeleton, person.joint_centres)
    for one in segments_on_model(model, model_joints(model), names):
        k = model.body_names.index(one.body)
        axes = OPENSIM_FROM_WORLD @ own.frames[own.segment_names.index(one.segment)]
        np.testing.assert_allclose(placed.rotation[k] @ one.axes, axes, atol=1e-9)
        np.testing.assert_allclose(one.axes.T @ one.axes, np.eye(3), atol=1e-12)


def test_the_centre_of_a_limb_is_its_upper_joint_and_that_of_the_pelvis_the_middle_of_the_hips(model):
    person = performer.body()
    found = {one.segment: one for one in segments_on_model(model, model_joints(model), ("pelvis", "left_shank"))}
    np.testing.assert_allclose(found["left_shank"].centre, 0.0, atol=1e-12)
    hips = [person.joint_centres[person.skeleton.segment(f"{side}_thigh")] for side in ("left", "right")]
    pelvis = person.joint_centres[person.skeleton.segment("pelvis")]
    np.testing.assert_allclose(found["pelvis"].centre, OPENSIM_FROM_WORLD @ (np.mean(hips, 0) - pelvis), atol=1e-12)


def test_segments_that_the_model_lacks_are_left_out(model):
    assert segments_on_model(model, {}, ("pelvis", "left_thigh")) == ()
    joints = model_joints(model)
    assert segment_body(model, joints, "left_thigh") == "left_thigh"
    assert segment_body(model, joints, "head") is None
    # The thorax of this model is not on the pelvis: an abdomen is between them.
    assert segments_on_model(model, joints, ("thorax",)) == ()


def test_coordinates_below_which_no_body_is_known_are_listed(model):
    listed = undriven_coordinates(model, ["pelvis", "left_shank"])
    assert not {"pelvis_tx", "pelvis_tilt"} & set(listed)
    assert not any(name.startswith(("left_hip", "left_knee")) for name in listed)
    assert any(name.startswith("right_hip") for name in listed)
    assert any(name.startswith("left_ankle") for name in listed)
