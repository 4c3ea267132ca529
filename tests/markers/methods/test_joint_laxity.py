import numpy as np
import pytest

from marey.markers.methods.joint_constraints import Give, laxity


def test_a_joint_is_known_on_either_side_and_by_its_bones():
    knee = laxity("thigh", "shank")
    assert knee.adduction is not None
    assert knee.rotation is not None
    assert laxity("left_thigh", "left_shank") == laxity("femur", "tibia") == knee
    assert laxity("right_upperarm", "right_forearm").rotation is None


def test_of_an_unknown_joint_only_the_centre_is_held_and_loosely():
    unknown = laxity("lid", "box")
    assert unknown.adduction is None
    assert unknown.rotation is None
    assert unknown.translation.anyway > laxity("thigh", "shank").translation.anyway


def test_instants_far_apart_differ_by_the_standard_deviations_said():
    give = Give(anyway=0.02, turned=0.03)
    assert 2 * give.semivariance(np.array(np.radians(45)), np.array(9.0)) == pytest.approx(0.02**2 + 0.03**2)
    assert give.semivariance(np.zeros(1), np.zeros(1)) == 0
