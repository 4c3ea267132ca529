"""A camera that agrees with the others in one part of a made walk only."""

import numpy as np
import pytest
from tests.fit.consistency.test_cut_outlines import without_feet
from tests.fit.consistency.test_explanations import turned, walk  # noqa: F401

from marey.fit.consistency.breaks import find_break
from marey.fit.consistency.tangents import Outline

FRAMES = range(14, 62, 2)
HALF = len(FRAMES) // 2


def broken(cameras, masks, camera, *, first=HALF, late=(0, 0), pictures=None):
    """Outlines of one camera whose pictures are late by two numbers of frames before and after an instant."""

    def outlines(c, shift=0):
        found = []
        for index, frame in enumerate(FRAMES):
            after = index >= first
            own = pictures if pictures is not None and c == camera and after else masks[c]
            mask = own[frame - (late[after] if c == camera else 0) + shift]
            found.append(Outline.of(np.asarray(mask), cameras[c]))
        return found

    return outlines


def found_in(cameras, shown):
    return find_break(cameras, FRAMES, shown, longest_delay=12)


def test_cameras_that_agree_have_no_break(walk):  # noqa: F811
    cameras, masks = walk
    assert found_in(cameras, broken(cameras, masks, 0)) is None


@pytest.mark.slow
@pytest.mark.parametrize("camera", range(4))
@pytest.mark.parametrize(("late", "after"), [((0, 9), True), ((-7, 0), False)])
def test_lost_pictures_are_found_with_their_number(walk, camera, late, after):  # noqa: F811
    cameras, masks = walk
    found = found_in(cameras, broken(cameras, masks, camera, late=late))
    assert (found.number, found.after) == (camera, after)
    # The silhouettes change slowly: a few frames near the instant agree with both parts.
    assert abs(found.first - HALF) <= 2
    assert found.delay == pytest.approx(sum(late), abs=1)


@pytest.mark.slow
def test_another_recording_is_explained_by_no_delay(walk):  # noqa: F811
    cameras, masks = walk
    other = [np.ascontiguousarray(mask[:, ::-1]) for mask in masks[2]]
    found = found_in(cameras, broken(cameras, masks, 2, first=15, pictures=other))
    assert (found.number, found.after, found.delay) == (2, True, 0)
    assert abs(found.first - 15) <= 1


def test_a_fault_of_all_pictures_is_no_break(walk):  # noqa: F811
    cameras, masks = walk
    assert found_in(cameras, broken(cameras, masks, 1, late=(9, 9))) is None
    moved = [*cameras[:3], turned(cameras[3], [0.03, 0.03, 0.0])]
    assert found_in(moved, broken(moved, masks, 0)) is None


def test_something_in_front_is_no_break(walk):  # noqa: F811
    cameras, masks = walk
    shown = broken(cameras, masks, 2, pictures=without_feet(masks[2]))
    assert found_in(cameras, shown) is None


def test_a_thing_in_one_silhouette_is_no_break(walk):  # noqa: F811
    cameras, masks = walk
    with_thing = [np.array(mask) for mask in masks[2]]
    for mask in with_thing:
        rows, columns = np.nonzero(mask)
        if len(rows):
            mask[rows.max() - 10 : rows.max(), columns.max() : columns.max() + 25] = True
    assert found_in(cameras, broken(cameras, masks, 2, pictures=with_thing)) is None


def test_of_two_cameras_none_can_be_named(walk):  # noqa: F811
    cameras, masks = walk
    assert found_in(cameras[:2], broken(cameras[:2], masks[:2], 0, late=(0, 9))) is None
