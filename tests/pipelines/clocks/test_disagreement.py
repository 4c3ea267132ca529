import numpy as np
import pytest
from tests import made_walk

from marey.pipelines.clocks.disagreement import LEAST_FRAMES, ClocksDisagree, require_common_clock


def checked(offsets, *, still=False, first=0, count=made_walk.FRAMES, blind=()):
    cameras = made_walk.cameras(len(offsets))
    masks = made_walk.silhouettes(cameras, made_walk.clocks(offsets), still=still)
    for camera in blind:
        masks[camera] = [np.zeros_like(mask) for mask in masks[camera]]
    frames = range(first, first + count)

    def mask_of(frame, camera):
        return masks[camera][frame - first]

    return require_common_clock(cameras, frames, mask_of, rate=made_walk.RATE)


@pytest.mark.slow
def test_cameras_of_one_clock_are_left_alone():
    assert checked([0, 0, 0]) is None
    assert checked([0, 0.1, -0.1]) is None


@pytest.mark.slow
@pytest.mark.parametrize("first", [0, 40])
def test_the_clocks_of_others_are_stated_for_the_whole_take(first):
    with pytest.raises(ClocksDisagree) as caught:
        checked([0, 0.7, -5.0], first=first)
    assert "cam02 0.02" in str(caught.value)
    assert "frames) earlier than cam01" in str(caught.value)
    middle = (first + made_walk.FRAMES / 2) / made_walk.RATE
    late = [caught.value.clocks.instants(c, np.array(middle)) - middle for c in range(3)]
    # The true offsets belong to times since the first of the frames, where the drift is zero.
    np.testing.assert_allclose(np.array(late) * made_walk.RATE, [0, 0.7, -5.0], atol=0.12)


@pytest.mark.slow
def test_nothing_is_said_of_a_person_who_does_not_move_or_of_a_short_take():
    assert checked([0, 3, 0], still=True) is None
    assert checked([0, 3, 0], count=LEAST_FRAMES - 1) is None


@pytest.mark.slow
def test_a_camera_without_a_clock_is_named_beside_one_that_disagrees():
    warning = checked([0, 4.0, 0], blind=[2])
    assert warning is not None
    assert warning.startswith("The silhouettes of cam02 seem to show other instants")
    assert "the clock of cam03 cannot be determined" in warning
