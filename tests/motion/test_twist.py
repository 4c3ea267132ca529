import numpy as np
import pytest

from marey.geometry import rotations
from marey.motion.twist import reduce_twist, twist_angles

AXIS = np.array([0.3, -0.2, -0.9])


def across(rng, count):
    """Rotation vectors across the axis: turns that only swing."""
    vectors = rng.normal(size=(count, 3))
    return vectors - np.outer(vectors @ AXIS, AXIS) / (AXIS @ AXIS)


def test_a_swing_has_no_twist(rng):
    np.testing.assert_allclose(twist_angles(rotations.exp(across(rng, 20)), AXIS), 0, atol=1e-12)


def test_the_twist_before_a_swing_is_found_beyond_a_whole_turn(rng):
    wanted = np.linspace(-2, 9, 60)
    swing = rotations.exp(np.cumsum(0.02 * across(rng, 60), axis=0))
    turns = swing @ rotations.about(AXIS / np.linalg.norm(AXIS), wanted)
    np.testing.assert_allclose(twist_angles(turns, AXIS), wanted, atol=1e-9)


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_a_share_of_the_twist_is_kept_and_the_limb_points_as_before(rng, share):
    parent, segment = (rotations.exp(np.cumsum(0.1 * rng.normal(size=(30, 3)), axis=0)) for _ in range(2))
    kept = reduce_twist(parent, segment, AXIS, share)
    np.testing.assert_allclose(kept @ AXIS, segment @ AXIS, atol=1e-12)
    whole, part = (twist_angles(np.swapaxes(parent, 1, 2) @ turns, AXIS) for turns in (segment, kept))
    np.testing.assert_allclose(part, share * whole, atol=1e-9)
