"""Scale factors of a model by the joint centres of a person, and masses by segment."""

import numpy as np
import pytest
from tests import performer

from marey.body.articulation.jointed_kinematics import place
from marey.body.articulation.model_scaling import (
    JointPlaces,
    body_scales,
    centre_in_ground,
    masses_by_group,
    model_joints,
    neutral_posture,
    scaled_to,
)
from marey.errors import MareyError
from marey.io.opensim.osim import write_osim
from marey.io.opensim.osim_model import read_osim_model


@pytest.fixture
def model(tmp_path):
    write_osim(tmp_path / "body.osim", performer.body(), mass_kg=70.0)
    return read_osim_model(tmp_path / "body.osim")


def person(model, sd=0.004, **moved):
    """The joint centres of a person who is the model in its neutral posture, some of them moved."""
    joints = model_joints(model)
    placed = place(model, neutral_posture(model))
    places = np.array([centre_in_ground(model, placed, body) for body in joints.values()])
    for name, by in moved.items():
        places[list(joints).index(name)] += by
    return JointPlaces(names=tuple(joints), places=places, covariance=sd**2 * np.eye(3 * len(joints)))


def factors(model, whole):
    return {scale.body: scale for scale in body_scales(model, model_joints(model), whole)}


def test_a_model_is_scaled_to_itself_by_one(model):
    for scale in factors(model, person(model)).values():
        np.testing.assert_allclose(scale.factors, 1.0, atol=1e-12)


def test_a_longer_limb_changes_its_own_factor_alone(model):
    whole = person(model)
    knee, ankle = (whole.places[whole.names.index(f"left_{joint}")] for joint in ("knee", "ankle"))
    toe = person(model).places[whole.names.index("left_toe")] - ankle
    by = 0.2 * (ankle - knee)
    found = factors(model, person(model, left_ankle=by, left_toe=by + 0 * toe))
    np.testing.assert_allclose(found["left_shank"].factors, 1.2, rtol=1e-12)
    others = [scale for name, scale in found.items() if name != "left_shank" and scale.measured]
    assert len(others) > 8
    for scale in others:
        np.testing.assert_allclose(scale.factors, 1.0, rtol=1e-9)


def test_wider_and_higher_shoulders_scale_the_trunk_along_its_axes(model):
    own = person(model)
    left, right = (own.places[own.names.index(f"{side}_shoulder")] for side in ("left", "right"))
    hips = np.mean([own.places[own.names.index(f"{side}_hip")] for side in ("left", "right")], 0)
    up, wide = 0.1 * ((left + right) / 2 - hips), 0.15 * (left - right) / 2
    moved = {f"{side}_shoulder": up + sign * wide for side, sign in (("left", 1), ("right", -1))}
    found = factors(model, person(model, **moved))
    placed = place(model, neutral_posture(model))
    below = centre_in_ground(model, placed, "abdomen")
    reached = (below - hips) + found["thorax"].factors[1] * ((left + right) / 2 - below)
    # The factor moves the shoulders along their own direction from the trunk's joint to the measured distance.
    assert np.linalg.norm(reached) == pytest.approx(1.1 * np.linalg.norm((left + right) / 2 - hips), rel=1e-12)
    assert found["thorax"].factors[2] == pytest.approx(1.15, rel=1e-12)


def test_the_deviation_of_a_factor_is_that_of_two_independent_joint_centres(model):
    whole = person(model, sd=0.006)
    found = factors(model, whole)["left_thigh"]
    length, sd = whole.distance("left_hip", "left_knee")
    assert sd == pytest.approx(0.006 * np.sqrt(2), rel=1e-9)
    np.testing.assert_allclose(found.sd, sd / length, rtol=1e-9)


def test_a_body_without_a_length_takes_the_factors_of_the_one_above_with_a_wider_interval(model):
    found = factors(model, person(model, left_wrist=np.array([0.0, -0.03, 0.0])))
    assert not found["left_hand"].measured
    np.testing.assert_array_equal(found["left_hand"].factors, found["left_forearm"].factors)
    assert (found["left_hand"].sd > found["left_forearm"].sd).all()


def test_legs_alone_scale_the_trunk_by_the_sum_of_the_limbs(model):
    whole = person(model)
    legs = [n for n, name in enumerate(whole.names) if name.split("_")[1] in ("hip", "knee", "ankle")]
    part = JointPlaces(
        names=tuple(whole.names[n] for n in legs), places=1.1 * whole.places[legs],
        covariance=np.zeros((3 * len(legs), 3 * len(legs))),
    )  # fmt: skip
    found = factors(model, part)
    np.testing.assert_allclose(found["thorax"].factors, 1.1, rtol=1e-9)
    assert found["abdomen"].source == "not measured: as the sum of the limbs"


def test_nothing_in_common_is_an_error(model):
    whole = person(model)
    none = JointPlaces(names=("neck",), places=whole.places[:1], covariance=np.zeros((3, 3)))
    with pytest.raises(MareyError, match="lies between"):
        body_scales(model, model_joints(model), none)


def test_joints_can_be_named_and_unknown_ones_are_refused(model):
    given = model_joints(model, {"left_hip": "left_knee"})
    assert given["left_hip"] == "left_shank"
    with pytest.raises(MareyError, match="no joint 'hip_left'"):
        model_joints(model, {"left_hip": "hip_left"})
    with pytest.raises(MareyError, match="no joint centre 'hip'"):
        model_joints(model, {"hip": "left_hip"})


def test_masses_stay_with_their_segments_and_add_up(model):
    own = dict.fromkeys(model.body_names, 2.0)
    segments = {name: 1.0 + k / 10 for k, name in enumerate(model.body_names)}
    masses = masses_by_group(model, model_joints(model), own, segments)
    assert sum(masses.values()) == pytest.approx(sum(segments.values()), rel=1e-12)
    assert masses["left_shank"] == pytest.approx(segments["left_shank"], rel=1e-12)
    assert masses["left_foot"] == pytest.approx(segments["left_foot"], rel=1e-12)
    # Those between pelvis and head, and what hangs on them without a joint centre, are one group.
    trunk = ["pelvis", "abdomen", "thorax", "neck", "head", "left_clavicle", "right_clavicle"]
    assert {round(masses[name], 9) for name in trunk} == {round(np.mean([segments[name] for name in trunk]), 9)}


def test_a_model_without_feet_carries_their_mass_on_the_shanks(model):
    own = {name: 0.0 if name.endswith(("foot", "toes")) else 1.0 for name in model.body_names}
    segments = dict.fromkeys(model.body_names, 1.0)
    masses = masses_by_group(model, model_joints(model), own, segments)
    assert masses["left_shank"] == pytest.approx(3.0)
    assert sum(masses.values()) == pytest.approx(len(segments))


def test_a_total_keeps_the_distribution():
    assert scaled_to({"a": 1.0, "b": 3.0}, 60.0) == {"a": 15.0, "b": 45.0}
    with pytest.raises(MareyError, match="no masses"):
        scaled_to({"a": 0.0}, 60.0)
