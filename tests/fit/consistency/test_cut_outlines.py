"""Contradictions that something in front of the person explains, in silhouettes of a made walk."""

import numpy as np
import pytest
from tests.fit.consistency.test_explanations import shown_by, turned, walk  # noqa: F401

from marey.fit.consistency.cut_outlines import cut_cameras
from marey.fit.consistency.tangents import differences_px


def found_in(cameras, masks, **changes):
    shown = shown_by(cameras, masks, **changes)
    return cut_cameras(differences_px(cameras, [shown(c) for c in range(len(cameras))]))


def without_feet(masks):
    """Silhouettes whose lowest sixth something hides."""
    cut = [np.array(mask) for mask in masks]
    for mask in cut:
        rows = np.flatnonzero(mask.any(axis=1))
        if len(rows):
            mask[rows[-1] - len(rows) // 6 :] = False
    return cut


@pytest.mark.parametrize("numbers", [(1,), (0, 2)])
def test_cameras_whose_silhouettes_are_cut_are_named(walk, numbers):  # noqa: F811
    cameras, masks = walk
    assert found_in(cameras, [without_feet(own) if c in numbers else own for c, own in enumerate(masks)]) == numbers


def test_cameras_that_agree_are_not_cut(walk):  # noqa: F811
    assert found_in(*walk) == ()


def test_with_one_clear_camera_left_that_one_may_be_wrong(walk):  # noqa: F811
    cameras, masks = walk
    assert found_in(cameras, [own if c == 3 else without_feet(own) for c, own in enumerate(masks)]) == ()


def test_other_faults_are_not_taken_for_something_in_front(walk):  # noqa: F811
    cameras, masks = walk
    for c in range(4):
        late = [0, 0, 0, 0]
        late[c] = 4
        assert found_in(cameras, masks, late=late) == ()
        moved = [turned(own, [0.05, 0.03, 0.0]) if k == c else own for k, own in enumerate(cameras)]
        assert found_in(moved, masks) == ()
