"""Floor, up and heading of made people whose feet stand on the floor in a tilted world."""

from dataclasses import replace

import numpy as np
import pytest

from marey.arrays import Floats
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.pipelines.from_person.planted_world import CapturedPerson3d, PlantedWorld, planted_world

RATE = 30.0
FOOT = np.array([[0.0, -0.05, 0.0], [0.0, 0.12, 0.0], [0.0, 0.17, 0.0]])
"""Heel, ball and toes of a foot relative to its ankle's place on the floor; ahead is +Y [m]."""
TILT = RigidTransform(rotations.exp(np.radians([7.0, -5.0, 40.0])), np.array([0.4, -0.3, 0.9]))
"""The tilted world from the true one."""


def person(
    feet: Floats, heel: Floats | float = 0.0, lean: float = 0.0, bounce: Floats | float = 0.0
) -> CapturedPerson3d:
    """A person with feet (K, 2, 3), heels at heights (K,), a lean to the front [m], and jumps to heights (K,) [m]."""
    count = len(feet)
    soles = feet[:, :, None] + FOOT
    soles[:, :, 0, 2] += np.broadcast_to(heel, count)[:, None]
    soles[..., 2] += np.broadcast_to(bounce, count)[:, None, None]
    middle = feet.mean(axis=1) + np.broadcast_to(bounce, count)[:, None] * [0.0, 0.0, 1.0]
    # The load is 60 % on the heel: the centre of mass is above that place.
    ahead = np.array([0.6, 0.32, 0.08]) @ FOOT[:, 1] if np.ndim(heel) == 0 and heel == 0 else FOOT[1, 1]
    return CapturedPerson3d(
        time=np.arange(count) / RATE, soles=soles.reshape(count, 6, 3), mass=middle + [0.0, ahead, 0.95],
        trunk=np.tile([0.0, lean, 1.3], (count, 1)), hips=middle + [0.0, 0.0, 0.9],
        right=np.tile([0.2, 0.0, 0.0], (count, 1)),
    )  # fmt: skip


def standing_feet(count: int = 60) -> Floats:
    return np.tile([[-0.15, 0.0, 0.0], [0.15, 0.0, 0.0]], (count, 1, 1))


def walking_feet(steps: int = 6, length: float = 0.7, frames: int = 16) -> Floats:
    """Feet (K, 2, 3) of which one stands while the other swings."""
    feet, place = [], np.array([[-0.08, 0.0, 0.0], [0.08, 0.0, 0.0]])
    for step in range(steps):
        swinging, share = step % 2, np.arange(frames) / frames
        moved = np.tile(place, (frames, 1, 1))
        moved[:, swinging, 1] += (length if step > 0 else length / 2) * share
        moved[:, swinging, 2] += 0.12 * np.sin(np.pi * share)
        feet.append(moved)
        place[swinging, 1] += length if step > 0 else length / 2
    return np.concatenate(feet)


def found_in_tilted_world(made: CapturedPerson3d) -> tuple[PlantedWorld, RigidTransform]:
    """The found world, and the motion to it from the true one."""
    found = planted_world(made.moved(TILT))
    assert found is not None
    return found, found.world_from_capture @ TILT


def tilt_deg(motion: RigidTransform) -> float:
    return float(np.degrees(np.arccos(np.clip(motion.rotation[2, 2], -1, 1))))


def test_floor_up_and_heading_of_a_standing_person_are_recovered():
    found, motion = found_in_tilted_world(person(standing_feet()))
    assert not found.walked
    assert not found.backwards
    # All evidence is exact and agrees.
    assert np.allclose(motion.rotation, np.eye(3), atol=1e-6)
    assert motion.translation == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)


def test_the_way_of_a_walk_sets_the_heading_and_is_level():
    made = person(walking_feet(), lean=0.1)
    found, motion = found_in_tilted_world(made)
    assert found.walked
    assert not found.backwards
    # The trunk leans ahead by 4.4 degrees; stances along 3 m of way contradict that by centimetres.
    assert tilt_deg(motion) < 0.2
    ahead = motion.rotation @ [0.0, 1.0, 0.0]
    assert np.degrees(np.arctan2(ahead[0], ahead[1])) == pytest.approx(0.0, abs=0.1)
    assert found.up_sd > np.radians(tilt_deg(motion))


def test_a_person_who_walks_backwards_or_is_mirrored_is_named():
    made = person(walking_feet())
    assert found_in_tilted_world(replace(made, right=-made.right))[0].backwards


def test_raised_heels_of_a_person_who_jumps_are_not_taken_for_the_floor():
    time = np.arange(90) / RATE
    jumps = np.maximum(0.15 * np.sin(2 * np.pi * 1.5 * time), 0.0)
    made = person(standing_feet(90), heel=np.full(90, 0.05), lean=0.15, bounce=jumps)
    found, motion = found_in_tilted_world(made)
    # A floor through raised heels and balls would be tilted by 16 degrees, up along the trunk by 7.
    assert tilt_deg(motion) < 2.5
    assert tilt_deg(motion) < 2 * np.degrees(found.up_sd)
    assert motion.translation[2] == pytest.approx(0.0, abs=0.015)


def test_evidence_that_contradicts_itself_enlarges_the_standard_deviations():
    plain, leaning = (found_in_tilted_world(person(standing_feet(), lean=lean))[0] for lean in (0.0, 0.6))
    assert leaning.up_sd > 1.2 * plain.up_sd


def test_no_floor_is_found_if_no_foot_stands_still():
    made = person(standing_feet())
    sliding = np.arange(60)[:, None, None] * np.array([0.0, 0.05, 0.0])
    assert planted_world(replace(made, soles=made.soles + sliding)) is None
