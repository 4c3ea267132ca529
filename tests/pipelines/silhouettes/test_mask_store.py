"""Silhouettes in the store: with and without the regions in which they are hidden."""

import numpy as np
import pytest
from tests import worlds

from marey.images.silhouettes.interior import InteriorEdges
from marey.io.stages import FrameLog
from marey.pipelines.silhouettes.mask_store import MaskStore

CAMERAS = worlds.ring(3, size=(44, 30))


@pytest.fixture
def store(tmp_path):
    with FrameLog(tmp_path / "masks.log") as log:
        yield MaskStore(log, 5, CAMERAS)


def masks(rng):
    return [rng.random((30, 44)) < 0.5 for _ in CAMERAS]


def test_hidden_regions_are_kept_beside_the_silhouettes_of_their_frame(store, rng):
    frames = [(masks(rng), masks(rng)) for _ in range(3)]
    for shown, hidden in frames:
        store.append(shown, [InteriorEdges.none()] * 3, hidden)
    assert store.frames == range(5, 8)
    for frame, (shown, hidden) in zip(store.frames, frames, strict=True):
        np.testing.assert_array_equal(store(frame), shown)
        np.testing.assert_array_equal(store.hidden(frame), hidden)


def test_frames_in_which_nothing_was_searched_for_have_no_hidden_regions(store, rng):
    store.append(masks(rng))
    store.append(masks(rng), hidden=[np.zeros((30, 44), bool)] * 3)
    assert store.hidden(5) is None
    np.testing.assert_array_equal(store.hidden(6), np.zeros((3, 30, 44)))


def test_a_reopened_store_has_the_same_hidden_regions(tmp_path, rng):
    shown, hidden = masks(rng), masks(rng)
    with FrameLog(tmp_path / "again.log") as log:
        MaskStore(log, 0, CAMERAS).append(shown, [], hidden)
    with FrameLog(tmp_path / "again.log") as log:
        store = MaskStore(log, 0, CAMERAS)
        np.testing.assert_array_equal(store(0), shown)
        np.testing.assert_array_equal(store.hidden(0), hidden)


def test_the_energy_of_a_frame_is_the_sum_of_its_images(store, rng):
    store.append(masks(rng), energy=[-10.0, -20.5, 3.0])
    store.append(masks(rng))
    assert store.energy(5) == -27.5
    assert np.isnan(store.energy(6))
