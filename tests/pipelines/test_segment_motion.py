"""Position and orientation of segments, by name."""

import numpy as np
import pytest
from tests import performer

from marey.geometry import rotations
from marey.motion.motion import LOST, MEASURED
from marey.pipelines.capture.motion import Motion
from marey.pipelines.labelled import UnknownName


@pytest.fixture(scope="module")
def motion() -> Motion:
    return Motion(performer.motion(performer.body()))


def test_a_segment_has_its_position_and_orientation(motion):
    data = motion.data
    s = data.segment_names.index("left_thigh")
    thigh = motion.segments["left thigh"]
    assert thigh.name == "left_thigh"
    np.testing.assert_array_equal(thigh.origin.values, data.segment_origin[:, s])
    np.testing.assert_array_equal(thigh.rotation, data.segment_rotation[:, s])
    assert (thigh.origin.unit, thigh.origin.components) == ("m", ("x", "y", "z"))
    assert thigh.origin.flags == motion.flags
    assert repr(thigh) == f"<Motion of the left thigh: {len(motion)} frames>"


def test_the_orientation_is_the_same_rotation_without_jumps(motion):
    thigh = motion.segments["left thigh"]
    known = np.isfinite(thigh.rotation).all((1, 2))
    assert known.any()
    quaternions = thigh.orientation.values
    np.testing.assert_allclose(rotations.from_quaternion(quaternions[known]), thigh.rotation[known], atol=1e-12)
    assert ((quaternions[known][1:] * quaternions[known][:-1]).sum(1) > 0).all()
    assert np.isnan(quaternions[~known]).all()
    assert set(np.array(thigh.orientation.flags)[motion.data.state == MEASURED]) == {""}
    assert set(np.array(thigh.orientation.flags)[motion.data.state == LOST]) <= {"lost"}


def test_segments_are_a_mapping_by_name(motion):
    assert tuple(motion.segments) == motion.data.segment_names
    assert len(motion.segments) == len(motion.data.segment_names)
    with pytest.raises(UnknownName, match=r"Did you mean: .*left thigh"):
        motion.segments["left tigh"]
