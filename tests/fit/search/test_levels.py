"""Shrunken silhouettes and the cameras that belong to them."""

import gc
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.fit.search.levels import FrameLevels, SilhouetteLevel, StoredLevel, level_factor, shrink
from marey.images.silhouettes.contours import trace_contour
from marey.images.silhouettes.interior import InteriorEdges


@pytest.fixture
def scene():
    cameras, body = worlds.ring(), worlds.person()
    posed = PosedBody(body, worlds.pose(body))
    return cameras, posed, worlds.silhouettes(posed, cameras)


@pytest.mark.parametrize("factor", [0.5, 0.25])
def test_a_shrunken_silhouette_is_what_the_shrunken_camera_sees_neither_thinner_nor_thicker(factor):
    cameras, body = worlds.ring(size=(400, 480), focal=600.0), worlds.person()
    poses = [worlds.pose(body, yaw=yaw, at=(0.01 * yaw, 0.02, 0)) for yaw in (0.0, 0.7, 1.9)]
    more = outline = 0
    for posed in (PosedBody(body, pose) for pose in poses):
        level = SilhouetteLevel.of(cameras, worlds.silhouettes(posed, cameras), factor)
        for small, mask, seen in zip(level.cameras, level.masks, worlds.silhouettes(posed, level.cameras), strict=True):
            assert mask.shape == seen.shape == (small.height, small.width)
            more += np.count_nonzero(mask) - np.count_nonzero(seen)
            outline += len(trace_contour(seen).pixels)
            # They differ along the outline.
            assert np.count_nonzero(mask ^ seen) < 0.5 * len(trace_contour(seen).pixels)
    # Half of the outline's pixels are on either side at random; the mean offset is small because they are many.
    assert abs(more) / outline < 3 * 0.5 / np.sqrt(outline)


def test_a_pixel_is_inside_if_most_of_its_area_is():
    mask = np.zeros((4, 4), bool)
    mask[0, 0] = mask[0, 2:] = mask[1, 2] = True
    np.testing.assert_array_equal(shrink(mask, (2, 2)), [[False, True], [False, False]])
    mask[:] = [True, False, True, False]
    np.testing.assert_array_equal(shrink(mask, (2, 2)), [[True, False], [False, True]])
    assert shrink(mask, (4, 4)) is mask


@pytest.mark.parametrize(
    ("height", "wanted", "factor"), [(160, 80, 0.5), (100, 80, 1.0), (70, 160, 1.0), (330, 80, 0.25)]
)
def test_the_factor_is_the_power_of_two_nearest_to_the_wanted_height(height, wanted, factor):
    mask = np.zeros((400, 50), bool)
    mask[10 : 10 + height, 20:30] = True
    assert level_factor([np.zeros_like(mask), mask], wanted) == factor


def test_pictures_are_never_enlarged_and_may_be_empty():
    assert level_factor([np.zeros((40, 50), bool)], 80) == 1.0


def test_packing_pads_masks_of_different_sizes_with_nothing(scene):
    cameras, _, masks = scene
    level = SilhouetteLevel.at_size([cameras[0], cameras[1].scaled(0.5)], [masks[0], shrink(masks[1], (100, 120))])
    packed, widths, heights, padded = level.packed()
    assert packed.shape[0] == 2
    np.testing.assert_array_equal(widths, [200, 100])
    np.testing.assert_array_equal(heights, [240, 120])
    assert padded.shape == (2, 240, 200)
    np.testing.assert_array_equal(padded[1, :120, :100], level.masks[1])
    assert not padded[1, 120:].any()
    assert not padded[1, :, 100:].any()


def test_frames_are_traced_once_on_demand(scene):
    cameras, _, masks = scene
    computed = []

    def masks_of(frame):
        computed.append(frame)
        return masks

    levels = FrameLevels(cameras, masks_of, 0.5)
    assert computed == []
    assert levels.at(7) is levels.at(7)
    assert computed == [7]
    assert levels.at(7).cameras[0].size == (100, 120)


def test_all_frames_stay_ready_as_long_as_there_is_room(scene):
    cameras, _, masks = scene
    one = FrameLevels(cameras, lambda frame: masks, 0.5).at(0).size
    assert one > 4 * 100 * 120
    levels = FrameLevels(cameras, lambda frame: masks, 0.5, room=40 * one)
    first = [levels.at(frame) for frame in range(40)]
    assert all(levels.at(frame) is level for frame, level in enumerate(first))


@pytest.mark.slow
def test_frames_are_kept_within_the_memory_limit(scene):
    cameras, _, masks = scene
    computed = []

    def masks_of(frame):
        computed.append(frame)
        return masks

    level = FrameLevels(cameras, masks_of, 0.5).at(0)
    stored = StoredLevel.of(level).size
    levels = FrameLevels(cameras, masks_of, 0.5, room=40 * level.size)
    # Of the memory, three quarters are for stored levels, which are those that were ready first, and a quarter for
    # those that are ready.
    room = int(30 * level.size / stored)
    frames = range(room + 30)
    computed.clear()
    for frame in frames:
        levels.at(frame)
    assert computed == list(frames)
    computed.clear()
    for frame in frames:
        levels.at(frame)
    assert computed == list(frames[room:])


@pytest.mark.parametrize("room", [0, 1 << 28])
def test_the_mask_of_one_camera_is_that_of_the_level_and_keeps_no_level(scene, room):
    cameras, _, masks = scene
    levels = FrameLevels(cameras, lambda frame: masks, 0.5, room=room)
    alone = levels.mask(0, 1)
    assert not levels._ready
    np.testing.assert_array_equal(alone, levels.at(0).masks[1])
    assert levels.mask(0, 1) is levels.at(0).masks[1]
    np.testing.assert_array_equal(StoredLevel.of(levels.at(0)).mask(1), alone)


def test_the_frames_that_were_used_last_stay_ready_without_room(scene):
    cameras, _, masks = scene
    levels = FrameLevels(cameras, lambda frame: masks, 0.5, room=0)
    last = [levels.at(frame) for frame in range(40)][-16:]
    levels.at(24)
    levels.at(40)
    assert levels.at(24) is last[0]
    assert levels.at(25) is not last[1]


def test_threads_that_make_a_frame_at_the_same_time_get_the_same_level(scene):
    cameras, _, masks = scene
    both = threading.Barrier(2, timeout=10)

    def masks_of(frame):
        both.wait()
        return masks

    levels = FrameLevels(cameras, masks_of, 0.5)
    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(levels.at, (0, 0))
    assert first is second


@pytest.mark.slow
def test_threads_get_the_frames_that_they_ask_for_while_others_are_stored_and_dropped(scene):
    cameras, _, masks = scene

    def masks_of(frame):
        return [np.roll(mask, frame, axis=1) for mask in masks]

    room = 20 * FrameLevels(cameras, masks_of, 0.5).at(0).size
    levels = FrameLevels(cameras, masks_of, 0.5, room=room)
    frames = np.random.default_rng(0).integers(0, 80, 600).tolist()
    wanted = [SilhouetteLevel.of(cameras, masks_of(frame), 0.5).masks[0] for frame in range(80)]
    with ThreadPoolExecutor(4) as pool:
        for frame, level in zip(frames, pool.map(levels.at, frames), strict=True):
            np.testing.assert_array_equal(level.masks[0], wanted[frame])


def test_a_stored_frame_is_equal_to_the_one_that_was_made(scene):
    cameras, _, masks = scene
    hidden = [np.broadcast_to(np.arange(mask.shape[0])[:, None] >= 200, mask.shape) for mask in masks]
    edges = InteriorEdges(
        pixels=np.array([[90.3, 101.0], [95.0, 120.5]]),
        inward=np.array([[0.6, 0.8], [1.0, 0.0]]),
        limb=np.array([2, 5]),
    )
    edges_of = [edges, *[InteriorEdges.none()] * (len(cameras) - 1)]
    made = FrameLevels(cameras, lambda frame: masks, 0.5, lambda frame: edges_of, lambda frame: hidden).at(0)
    again = StoredLevel.of(made).level()
    assert again.cameras == made.cameras
    for name in ("masks", "hidden"):
        for one, other in zip(getattr(made, name), getattr(again, name), strict=True):
            np.testing.assert_array_equal(one, other, strict=True)
    for one, other in zip(made.sightings, again.sightings, strict=True):
        np.testing.assert_array_equal(one.contour.mask, other.contour.mask, strict=True)
        np.testing.assert_array_equal(one.contour.pixels, other.contour.pixels, strict=True)
        for lines in ("contour", "edges"):
            first, second = getattr(one.packed, lines), getattr(other.packed, lines)
            for each, stored in zip((*first[1:], *first.cells), (*second[1:], *second.cells), strict=True):
                np.testing.assert_array_equal(each, stored, strict=True)
    assert len(made.sightings[0].packed.edges.limb) == 2
    assert StoredLevel.of(made).size < 0.25 * made.size


def test_a_frame_is_stored_without_what_it_does_not_have(scene):
    cameras, _, masks = scene
    made = FrameLevels(cameras, lambda frame: masks, 0.5).at(0)
    again = StoredLevel.of(made).level()
    assert again.hidden is None
    assert [sighting.interior for sighting in again.sightings] == [None] * len(cameras)
    empty = SilhouetteLevel.of(cameras, [np.zeros_like(mask) for mask in masks], 0.5)
    assert [len(sighting.contour.pixels) for sighting in StoredLevel.of(empty).level().sightings] == [0] * len(cameras)


def test_released_levels_free_their_memory(scene):
    cameras, _, masks = scene
    one = FrameLevels(cameras, lambda frame: masks, 0.5).at(0).size
    levels = FrameLevels(cameras, lambda frame: masks, 0.5, room=2 * one)
    first = levels.at(0)
    levels.forget()
    assert levels.at(1) is levels.at(1)
    assert levels.at(0) is not first
    assert [levels.at(frame) is levels.at(frame) for frame in (0, 1)] == [True, True]


def test_the_next_frame_is_made_ready_while_the_caller_works_on_this_one(scene):
    cameras, _, masks = scene
    begun = threading.Event()

    def masks_of(frame):
        if frame == 4:
            begun.set()
        return masks

    levels = FrameLevels(cameras, masks_of, 0.5)
    frames = levels.ahead([3, 4, 5])
    assert next(frames) == 3
    assert begun.wait(10)
    assert list(frames) == [4, 5]
    assert list(levels.ahead([])) == []


@pytest.mark.parametrize("factor", [1.0, 0.5])
def test_regions_that_are_hidden_are_shrunken_too_and_have_no_outline(scene, factor):
    cameras, _, masks = scene
    hidden = [np.broadcast_to(np.arange(mask.shape[0])[:, None] >= 120, mask.shape) for mask in masks]
    seen = [mask & ~behind for mask, behind in zip(masks, hidden, strict=True)]
    free = FrameLevels(cameras, lambda frame: seen, factor).at(0)
    level = FrameLevels(cameras, lambda frame: seen, factor, hidden_of=lambda frame: hidden).at(0)
    edge = 120 * factor - 1
    for one, other in zip(free.sightings, level.sightings, strict=True):
        assert one.contour.pixels[:, 1].max() == edge
        # Two pixels beside the hidden region are left out at any size.
        expected = one.contour.pixels[one.contour.pixels[:, 1] < edge - 1]
        np.testing.assert_array_equal(other.contour.pixels, expected)


def test_levels_are_released_without_garbage_collection(scene):
    cameras, _, masks = scene
    levels = FrameLevels(cameras, lambda frame: masks, 1.0)
    level = weakref.ref(levels.at(0))
    gc.disable()
    try:
        del levels
        assert level() is None
    finally:
        gc.enable()
