"""Which foot loads which plate, and force, point and free moment of each contact."""

from dataclasses import replace

import numpy as np
import pytest

from marey.markers.data.force_plates import ForcePlate
from marey.markers.preprocessing.foot_loads import foot_loads, plate_contacts, without_offset

RATE, FRAMES = 1000.0, 100.0
CORNERS = np.array([[0.4, 0.6, 0], [0.4, 0.0, 0], [0.0, 0.0, 0], [0.0, 0.6, 0]])
CENTRE = np.array([0.2, 0.3, 0.0])
AT = np.array([0.25, 0.35, 0.0])


def plate(begin=500, end=1200, free=3.0, count=2000, name="force_plate_1"):
    """A plate that carries 600 N, and 40 N forward, at one place, with a free moment about the vertical [N m]."""
    on = np.zeros(count)
    on[begin:end] = 1.0
    force = on[:, None] * [40.0, -10.0, 600.0]
    moment = np.cross(AT - CENTRE, force) + on[:, None] * [0.0, 0.0, free]
    return ForcePlate(name=name, corners=CORNERS, rate=RATE, force=force, moment=moment)


def ankle(x, y, z=0.08, frames=201):
    return np.tile([x, y, z], (frames, 1)).astype(float)


def walking(frames=201):
    """An ankle that passes over the plate in swing, 12 cm above the floor, and stands far away before and after."""
    x = np.interp(np.arange(frames), [0, 60, 110, frames - 1], [-0.6, -0.6, 0.9, 0.9])
    high = np.interp(np.arange(frames), [0, 60, 85, 110, frames - 1], [0.08, 0.08, 0.2, 0.08, 0.08])
    return np.stack([x, np.full(frames, 0.2), high], 1)


def test_the_load_acts_at_the_centre_of_pressure_with_its_free_moment_and_is_zero_outside():
    found = plate_contacts([plate()], {"left": ankle(0.2, 0.35), "right": walking()}, rate=FRAMES)
    assert [(c.side, c.begin, c.end) for c in found] == [("left", 500, 1200)]
    (load,) = foot_loads([plate()], found)
    np.testing.assert_allclose(load.force[500:1200], np.tile([40.0, -10.0, 600.0], (700, 1)))
    np.testing.assert_allclose(load.point, np.tile(AT, (2000, 1)), atol=1e-12)
    np.testing.assert_allclose(load.moment[500:1200], np.tile([0.0, 0.0, 3.0], (700, 1)), atol=1e-9)
    assert not load.force[:500].any()
    assert not load.moment[1200:].any()


def test_force_and_free_moment_have_the_moment_of_the_plate():
    own = plate(free=-2.0)
    (load,) = foot_loads([own], plate_contacts([own], {"right": ankle(0.2, 0.3)}, rate=FRAMES))
    whole = np.cross(load.point - CENTRE, load.force) + load.moment
    np.testing.assert_allclose(whole, own.moment, atol=1e-9)


def test_a_load_of_both_feet_is_left_out_and_stated():
    found = plate_contacts([plate()], {"left": ankle(0.2, 0.4), "right": ankle(0.2, 0.2)}, rate=FRAMES)
    assert [(c.side, c.problem) for c in found] == [(None, "both feet stand on it")]
    assert foot_loads([plate()], found) == ()


def test_a_foot_that_stands_beside_the_plate_does_not_take_part():
    found = plate_contacts([plate()], {"left": ankle(0.2, 0.4), "right": ankle(0.2, -0.2)}, rate=FRAMES)
    assert [c.side for c in found] == ["left"]


@pytest.mark.parametrize("far", [ankle(0.2, 1.2), np.full((201, 3), np.nan)])
def test_a_load_without_a_foot_is_left_out_and_stated(far):
    found = plate_contacts([plate()], {"left": far}, rate=FRAMES)
    assert [(c.side, c.problem) for c in found] == [(None, "no foot is near its centre of pressure")]


def test_a_short_disturbance_is_no_load():
    assert plate_contacts([plate(500, 540)], {"left": ankle(0.2, 0.35)}, rate=FRAMES) == ()


def test_the_offset_of_an_unloaded_plate_is_subtracted():
    own, shift = plate(), np.array([3.0, -19.0, -6.0])
    biased = replace(own, force=own.force + shift, moment=own.moment + [0.5, -1.0, 0.2])
    corrected, offset = without_offset(biased)
    np.testing.assert_allclose(offset, shift, atol=1e-12)
    np.testing.assert_allclose(corrected.force, own.force, atol=1e-9)
    np.testing.assert_allclose(corrected.moment, own.moment, atol=1e-9)


def test_a_plate_that_is_never_unloaded_stays_as_it_is():
    own = plate(0, 2000)
    corrected, offset = without_offset(own)
    assert corrected is own
    assert not offset.any()
