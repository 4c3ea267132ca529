"""Shrunken silhouettes and the cameras that belong to them."""

import gc
import threading
import weakref

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.fit.search.levels import FrameLevels, SilhouetteLevel, level_factor, shrink
from marey.images.silhouettes.contours import trace_contour


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


def test_frames_are_kept_within_the_memory_limit(scene):
    cameras, _, masks = scene
    computed = []

    def masks_of(frame):
        computed.append(frame)
        return masks

    one = FrameLevels(cameras, masks_of, 0.5).at(0).size
    assert one > 4 * 100 * 120
    levels = FrameLevels(cameras, masks_of, 0.5, room=3 * one)
    computed.clear()
    for _ in range(2):
        for frame in range(40):
            levels.at(frame)
    assert computed == [*range(40), *range(3, 40)]


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
