import numpy as np
import pytest

from marey.errors import MareyError
from marey.markers.data.bone_motion import BoneMotion, combine_bones


def motion(*segments: str) -> BoneMotion:
    count = len(segments)
    covariance = np.broadcast_to(np.diag(np.arange(1.0, 7.0) ** 2), (2, count, 6, 6))
    rotation = np.broadcast_to(np.eye(3), (2, count, 3, 3))
    return BoneMotion(segments=segments, rotation=rotation, origin=np.zeros((2, count, 3)), covariance=covariance)


def test_standard_deviations_are_the_roots_of_the_covariance():
    one = motion("thigh")
    np.testing.assert_allclose(one.rotation_sd[0, 0], [1, 2, 3])
    np.testing.assert_allclose(one.origin_sd[0, 0], [4, 5, 6])


def test_bones_side_by_side_keep_their_names():
    both = combine_bones([motion("thigh"), motion("shank")])
    assert both.segments == ("thigh", "shank")
    assert both.answered.all()
    with pytest.raises(MareyError, match="no segment 'foot'"):
        both.bone("foot")
