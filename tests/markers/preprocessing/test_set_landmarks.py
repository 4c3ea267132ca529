"""Landmarks and joint centres of a known marker set."""

from dataclasses import replace

import numpy as np
import pytest
from tests.marker_set_trials import ANKLE_WIDTH, DIAMETER, KNEE_WIDTH, LEG, lower_body, person, standing, walking
from tests.trials import RATE

from marey.errors import MareyError
from marey.markers.data.marker_set_tables import MARKER_SETS
from marey.markers.data.person import PersonMeasurements
from marey.markers.data.trajectories import trajectories
from marey.markers.preprocessing.set_landmarks import landmarks_of_set, with_joint_centres

PIG = MARKER_SETS[0]
SIZES = {"leg_length": LEG, "knee_width": KNEE_WIDTH, "ankle_width": ANKLE_WIDTH}
MEASURED = PersonMeasurements(
    lengths={f"{side}_{what}": size for side in ("left", "right") for what, size in SIZES.items()}, diameter_m=DIAMETER
)
UP = np.array([0.0, 0.0, 1.0])


def places(*more: str, without: tuple[str, ...] = ()) -> dict[str, np.ndarray]:
    points = lower_body(person(standing(1)), *more)
    return {label: path[0] for label, path in points.items() if label not in without}


def found(at, measured=MEASURED, *, stands: bool = True) -> dict[str, np.ndarray]:
    return dict(landmarks_of_set(PIG, at, measured, up=UP, standing=stands).places)


def test_widths_and_medial_markers_give_the_same_landmarks():
    by_width, by_marker = found(places()), found(places("KNM", "MED"), replace(MEASURED, lengths={}))
    for name in ("left_KJC", "right_AJC", "left_ME", "right_MM"):
        # The leg length of the second comes from the markers, which moves the hip by less than 4 mm: a regression
        # coefficient of 0.04 and a leg length that differs by less than 100 mm. The medial markers do not depend on it.
        np.testing.assert_allclose(by_width[name], by_marker[name], atol=1e-9)


def test_the_hip_is_that_of_the_regression_and_the_knee_below_it():
    known = found(places())
    assert known["right_HJC"][1] == pytest.approx(-known["left_HJC"][1])
    np.testing.assert_allclose(known["left_HJC"] - known["left_KJC"], [0, 0, 0.42], atol=1e-9)


def test_the_foot_of_a_standing_person_is_horizontal():
    at = places()
    at["LHEE"] = at["LHEE"] + [0, 0, 0.02]
    known = found(at)
    middle = (known["left_M1"] + known["left_M5"]) / 2
    assert (middle - known["left_CA"])[2] == pytest.approx(0)
    assert known["left_M1"][1] < known["left_M5"][1]  # the person looks along x: left is y, and the big toe inside


def test_the_foot_of_another_posture_keeps_its_inclination():
    at = places()
    at["RHEE"] = at["RHEE"] + [0, 0, 0.02]
    known = found(at, stands=False)
    np.testing.assert_allclose(known["right_CA"], at["RHEE"])
    np.testing.assert_allclose((known["right_M1"] + known["right_M5"]) / 2, at["RTOE"])
    assert known["right_M5"][1] < known["right_M1"][1]


def test_an_incomplete_leg_is_left_out_and_named():
    result = landmarks_of_set(PIG, places(without=("LKNE",)), MEASURED, up=UP, standing=True)
    assert "The left leg is left out without LKNE." in result.notes
    assert not any(name.startswith("left") for name in result.places)


@pytest.mark.parametrize(
    ("more", "lengths", "diameter", "expected"),
    [
        ((), {}, 0.014, ["left_knee_width", "left_ankle_width", "right_knee_width", "right_ankle_width"]),
        (("KNM",), {}, 0.014, ["left_ankle_width", "right_ankle_width"]),
        (("KNM", "MED"), {}, None, ["marker_diameter"]),
        ((), MEASURED.lengths, None, ["marker_diameter"]),
        ((), MEASURED.lengths, 0.014, []),
    ],
)
def test_what_nothing_states_is_assumed_and_named(more, lengths, diameter, expected):
    person_ = PersonMeasurements(lengths=lengths, diameter_m=diameter)
    result = landmarks_of_set(PIG, places(*more), person_, up=UP, standing=True)
    assert [one.name for one in result.assumed] == expected
    assert any("Assumed, because nothing states it" in note for note in result.notes) == bool(expected)


def test_a_width_larger_by_its_deviation_moves_the_centre_by_half_of_it():
    """The lateral marker, the centre and the hip form a right triangle: the distance is the side along the marker."""
    small, large = (found(places(), MEASURED.with_value("left_knee_width", width)) for width in (0.1, 0.109))
    moved = np.linalg.norm(large["left_KJC"] - places()["LKNE"]) - np.linalg.norm(small["left_KJC"] - places()["LKNE"])
    assert moved == pytest.approx(0.0045)
    np.testing.assert_array_equal(large["right_KJC"], small["right_KJC"])


@pytest.mark.parametrize(
    ("at", "measured", "expected"),
    [
        (places(without=("LASI",)), MEASURED, "pelvis are missing: LASI"),
        (places(without=("LKNE", "RANK")), MEASURED, "without LKNE. The right leg is left out without RANK"),
        (places(without=("LTHI",)), MEASURED, r"left knee needs a marker on its medial side \(LKNM, LKNEIN\) or LTHI"),
    ],
)
def test_what_is_missing_is_named(at, measured, expected):
    with pytest.raises(MareyError, match=expected):
        found(at, measured)


def test_joint_centres_follow_the_bones_above_them():
    angles = walking()
    points, known = lower_body(person(angles)), found(places())
    trial = trajectories(list(points), np.stack(list(points.values()), 1), RATE)
    segments = {name: tuple(x for x in labels if x in points) for name, labels in PIG.segments.items()}
    centred = with_joint_centres(trial, segments, places(), known)
    assert centred.added == ("left_HJC", "left_KJC", "left_AJC", "right_HJC", "right_KJC", "right_AJC")
    full = person(angles)
    for centre, pair in (("left_KJC", ("LKNE", "LKNM")), ("right_AJC", ("RANK", "RMED"))):
        path = centred.trajectories.select([centre]).points[:, 0]
        np.testing.assert_allclose(path, (full[pair[0]] + full[pair[1]]) / 2, atol=1e-9)
    assert [len(cluster.labels) for cluster in centred.clusters] == [4, 3, 3, 3, 3, 3, 3]
    assert centred.clusters[1].computed == ("left_HJC",)


def test_segments_with_three_markers_get_no_centre():
    known = MARKER_SETS[2]
    points = lower_body(person(walking()), "THAP", "THAD", "TIAP", "TIAD")
    trial = trajectories(list(points), np.stack(list(points.values()), 1), RATE)
    at = {label: path[0] for label, path in lower_body(person(standing(1)), "THAP", "THAD", "TIAP", "TIAD").items()}
    segments = {name: tuple(x for x in labels if x in points) for name, labels in known.segments.items()}
    centred = with_joint_centres(trial, segments, at, found(places()))
    assert centred.added == ("left_AJC", "right_AJC")
