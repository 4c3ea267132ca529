"""Hips that are placed by lengths that were measured on the person."""

from dataclasses import replace

import numpy as np
import pytest

from marey.body.people.departures import JOINT_SD
from marey.body.people.known_lengths import (
    HELD_SHARE,
    LEG_SD,
    MOST_SD,
    SPINES_SD,
    KnownLengths,
    _lengths,
    can_place_hips,
    hip_distance,
    hip_to_ankle,
    place_hips,
)
from marey.body.people.person import JOINT_SHARE, person_body

LATERAL, UP = JOINT_SD["hip"][0], JOINT_SD["hip"][2]


@pytest.fixture(scope="module")
def person():
    """A person whose sizes the images have measured well."""
    body = person_body("coarse")
    return replace(body, numbers_covariance=0.01**2 * np.eye(len(body.numbers)))


def legs(body):
    """The mean length from hip to ankle past the knee."""
    place = dict(zip(body.skeleton.segment_names, body.space.joints(body.numbers), strict=True))
    pieces = [
        np.linalg.norm(place[f"{side}_{end}"] - place[f"{side}_{start}"])
        for side in ("left", "right") for start, end in (("thigh", "shank"), ("shank", "foot"))
    ]  # fmt: skip
    return sum(pieces) / 2


def hips(body):
    place = dict(zip(body.skeleton.segment_names, body.space.joints(body.numbers), strict=True))
    return np.linalg.norm(place["left_thigh"] - place["right_thigh"])


def leg_length(between_joints):
    """The leg length that gives a length between joint centres."""
    return (between_joints + 0.009) / 0.922


def asis_distance(between_hips):
    return (between_hips / 2 - 0.0073) / 0.33


def test_lengths_between_joints_follow_from_measured_ones():
    # [Hara2016]: the hip of a leg of 900 mm lies 79.2 mm below the spine.
    assert hip_to_ankle(0.900) == pytest.approx(0.900 - 0.0792, abs=1e-9)
    # [Harrington2007]: 240 mm between the spines, 86.5 mm from the middle to each hip.
    assert hip_distance(0.240) == pytest.approx(2 * 0.0865, abs=1e-9)


@pytest.mark.parametrize("number", [0, 3, -1])
def test_the_derivatives_of_a_length_are_differences(person, number):
    body = person.with_numbers(0.3 * np.sin(np.arange(len(person.numbers))))
    step = np.zeros(len(body.numbers))
    step[number] = 1e-5
    for length in _lengths(KnownLengths(leg_m=0.9, asis_m=0.24), body.skeleton):
        change = length.of(body.with_numbers(body.numbers + step)) - length.of(body.with_numbers(body.numbers - step))
        assert length.by_number(body)[number] == pytest.approx(change / 2e-5, abs=1e-8)


@pytest.mark.parametrize("gap", [-0.02, 0.03])
def test_a_leg_length_moves_the_hips_a_part_of_the_way_and_leaves_the_skin(person, gap):
    placed = place_hips(person, KnownLengths(leg_m=leg_length(legs(person) + gap)))
    offset = (1 - JOINT_SHARE**2) * UP**2
    # The rest posture's legs are nearly vertical.
    assert placed.moved_m["leg length"] == pytest.approx(gap * offset / (offset + LEG_SD**2), rel=0.02)
    assert legs(placed.body) - legs(person) == pytest.approx(placed.moved_m["leg length"], rel=0.02)
    assert hips(placed.body) == pytest.approx(hips(person), abs=1e-6)
    np.testing.assert_allclose(placed.body.vertices, person.vertices, atol=1e-12)
    number = person.space.names.index("hip_up")
    assert placed.body.space.prior_mean[number] == placed.body.numbers[number]
    assert np.sqrt(placed.body.space.prior_covariance[number, number]) == pytest.approx(HELD_SHARE)


def test_a_distance_of_spines_moves_both_hips_to_their_sides(person):
    placed = place_hips(person, KnownLengths(asis_m=asis_distance(hips(person) - 0.03)))
    moved = placed.moved_m["ASIS distance"]
    assert -0.015 < moved < -0.01
    assert hips(placed.body) - hips(person) == pytest.approx(2 * moved, rel=1e-6)


def test_the_stated_offset_of_placed_hips_is_that_of_drawn_people(person, rng):
    """Hips are drawn about the skin and lengths are measured with errors: what remains has the stated spread."""
    errors = []
    sd_up, sd_lateral = (np.sqrt(1 - JOINT_SHARE**2) * sd for sd in (UP, LATERAL))
    known_number = [person.space.names.index(name) for name in ("hip_up", "hip_lateral")]
    for _ in range(300):
        true_up, true_lateral = rng.normal(size=2) * (sd_up, sd_lateral)
        leg = legs(person) + true_up + rng.normal() * LEG_SD
        wide = hips(person) + 2 * true_lateral + rng.normal() * SPINES_SD
        placed = place_hips(person, KnownLengths(leg_m=leg_length(leg), asis_m=asis_distance(wide)))
        moved = (placed.body.numbers - person.numbers)[known_number] * (UP, LATERAL)
        errors.append(moved - (true_up, true_lateral))
    thigh = person.skeleton.segment("left_thigh")
    gained = 3 * (person.joint_offset_sd[thigh] ** 2 - placed.body.joint_offset_sd[thigh] ** 2)
    remaining = sd_up**2 + sd_lateral**2 - gained
    # The variance of 300 draws of two errors has a relative standard deviation of at most sqrt(2 / 300) = 0.08.
    assert np.mean(np.sum(np.square(errors), axis=1)) == pytest.approx(remaining, rel=0.25)
    assert remaining < 0.5 * (sd_up**2 + sd_lateral**2)


def test_a_length_of_another_unit_or_person_is_refused(person):
    placed = place_hips(person, KnownLengths(leg_m=0.9 * 1.3, asis_m=asis_distance(hips(person))))
    assert placed.refused == {"leg length": pytest.approx(legs(person))}
    assert placed.moved_m["ASIS distance"] == pytest.approx(0, abs=1e-6)
    sd = np.sqrt((1 - JOINT_SHARE**2) * UP**2 + LEG_SD**2)
    almost = place_hips(person, KnownLengths(leg_m=leg_length(legs(person) + 0.9 * MOST_SD * sd)))
    assert not almost.refused


def test_sizes_that_the_images_hardly_show_move_the_hips_less(person):
    known = KnownLengths(leg_m=leg_length(legs(person) + 0.02))
    unsure = replace(person, numbers_covariance=np.asarray(person.space.prior_covariance))
    assert place_hips(unsure, known).moved_m["leg length"] < 0.3 * place_hips(person, known).moved_m["leg length"]


def test_nothing_known_changes_nothing(person):
    assert place_hips(person, KnownLengths()).body is person


def test_hips_of_bodies_without_both_legs_are_not_placed(person):
    assert can_place_hips(person)
    assert not can_place_hips(person_body("coarse", preset="upper"))
    assert not can_place_hips(person_body("coarse", preset="left_leg"))
    fixed = replace(person.space, names=tuple(f"number_{i}" for i in range(len(person.space))))
    assert not can_place_hips(replace(person, space=fixed))
