"""Images of the empty room that belong to another room, found by what never changes in one camera alone."""

import numpy as np
import pytest
from tests import made_walk

from marey.pipelines.consistency.check import check_cameras
from marey.pipelines.consistency.empty_room import foreign_foreground, wrong_empty_rooms
from marey.pipelines.consistency.repairs import CamerasContradict

COUNT = 12


@pytest.fixture(scope="module")
def walk():
    cameras = [camera.scaled(2.0) for camera in made_walk.cameras()]
    return cameras, made_walk.silhouettes(cameras, made_walk.clocks([0] * 4), frames=[COUNT] * 4)


def with_wall(masks, *numbers):
    """Add a wall at the left border to the foreground of some cameras."""

    def mask_of(frame, camera):
        mask = np.array(masks[camera][frame])
        if camera in numbers:
            mask[:, : mask.shape[1] // 3] = True
        return mask

    return mask_of


def test_sound_silhouettes_have_no_foreign_foreground(walk):
    cameras, masks = walk
    found = foreign_foreground(cameras, range(COUNT), with_wall(masks))
    np.testing.assert_allclose(found.shares, 0.0, atol=0.05)
    assert found.numbers == ()


def test_a_wall_in_one_camera_is_foreign_there_only(walk):
    cameras, masks = walk
    found = foreign_foreground(cameras, range(COUNT), with_wall(masks, 2))
    assert found.numbers == (2,)
    assert found.masks[2][:, 0].all()
    reason = wrong_empty_rooms(cameras, found)
    assert (reason.cause, reason.cameras) == ("empty room", ("cam03",))


def test_the_camera_with_a_wrong_empty_room_is_left_out(walk):
    cameras, masks = walk
    frames = range(COUNT)
    with pytest.raises(CamerasContradict) as caught:
        check_cameras(cameras, cameras, frames, frames, with_wall(masks, 2), rate=made_walk.RATE, clocks=True)
    assert caught.value.repairs.left_out == ("cam03",)
    assert [reason.cause for reason in caught.value.repairs.reasons] == ["empty room"]
