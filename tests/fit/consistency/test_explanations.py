from dataclasses import replace

import numpy as np
import pytest
from tests import made_walk

from marey.fit.consistency.explanations import CONTRADICTION_PX, common_lens, contradictions
from marey.fit.consistency.tangents import Outline, differences_px
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform

FRAMES = range(20, 60, 4)


@pytest.fixture(scope="module")
def walk():
    cameras = [camera.scaled(2.0) for camera in made_walk.cameras()]
    return cameras, made_walk.silhouettes(cameras, made_walk.clocks([0, 0, 0, 0]), frames=[80] * 4)


def shown_by(cameras, masks, *, late=(0, 0, 0, 0), flip=None):
    """Outlines of pictures that may be late, or of one camera flipped along some axes."""

    def outlines(camera, shift=0):
        found = []
        for frame in FRAMES:
            mask = masks[camera][frame - late[camera] + shift]
            if flip is not None and camera == flip[0]:
                mask = np.ascontiguousarray(np.flip(mask, flip[1]))
            found.append(Outline.of(mask, cameras[camera]))
        return found

    return outlines


def turned(camera, vector):
    rotation, pose = rotations.exp(np.array(vector)), camera.camera_from_world
    return replace(camera, camera_from_world=RigidTransform(rotation @ pose.rotation, rotation @ pose.translation))


def zoomed(matrix, factor):
    return np.array(matrix) * [[factor, factor, 1], [1, factor, 1], [1, 1, 1]]


def test_cameras_that_agree_are_not_explained(walk):
    cameras, masks = walk
    found = contradictions(cameras, shown_by(cameras, masks), longest_delay=5)
    assert not found.exist
    assert found.explanations == ()
    assert found.level_px < 1.0
    assert len(found.pairs_px) == 6


@pytest.mark.slow
def test_exchanged_cameras_are_named(walk):
    cameras, masks = walk
    found = contradictions(cameras, shown_by(cameras, [masks[2], masks[1], masks[0], masks[3]]))
    assert found.exist
    assert found.best.kind == "exchanged"
    assert found.best.numbers == (0, 2)
    assert found.best.order == (2, 1, 0, 3)
    assert found.best.level_px < 1.0
    assert found.rivals == ()


@pytest.mark.slow
def test_a_late_camera_and_its_delay_are_named(walk):
    cameras, masks = walk
    found = contradictions(cameras, shown_by(cameras, masks, late=(0, 0, 9, 0)), longest_delay=12)
    assert found.best.kind == "late"
    assert (found.best.numbers, found.best.amount) == ((2,), 9)


@pytest.mark.slow
def test_several_late_cameras_are_explained_by_given_shifts(walk):
    cameras, masks = walk
    shown = shown_by(cameras, masks, late=(0, 6, 9, 0))
    found = contradictions(cameras, shown, longest_delay=12, shifts=[0, 6, 9, 0])
    assert found.best.kind == "late"
    assert found.best.numbers == (1, 2)


@pytest.mark.slow
def test_of_one_late_camera_the_others_are_not_called_early(walk):
    cameras, masks = walk
    shown = shown_by(cameras, masks, late=(9, 0, 0, 0))
    found = contradictions(cameras, shown, longest_delay=12, shifts=[0, -9, -9, -9])
    assert (found.best.numbers, found.best.amount) == ((0,), 9)
    assert found.rivals == ()


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.85, 1.2])
def test_one_factor_of_all_focal_lengths_is_found_and_named(walk, factor):
    cameras, masks = walk
    wrong = [replace(camera, matrix=zoomed(camera.matrix, factor)) for camera in cameras]
    found = common_lens(wrong, shown_by(wrong, masks))
    assert (found.best.kind, found.best.numbers) == ("focal length", (0, 1, 2, 3))
    # Sound takes have factors of 0.994 to 1.016: the silhouettes themselves are good to that.
    assert found.best.amount == pytest.approx(1 / factor, rel=0.03)


@pytest.mark.slow
def test_sound_cameras_and_a_single_moved_one_have_no_common_factor(walk):
    cameras, masks = walk
    assert common_lens(cameras, shown_by(cameras, masks)) is None
    moved = [*cameras[:3], turned(cameras[3], [0.03, 0.03, 0.0])]
    assert common_lens(moved, shown_by(moved, masks)) is None


@pytest.mark.slow
def test_a_camera_that_was_turned_is_named_with_its_angle(walk):
    cameras, masks = walk
    moved = [*cameras[:3], turned(cameras[3], [0.03, 0.03, 0.0])]
    found = contradictions(moved, shown_by(moved, masks), longest_delay=5)
    assert found.best.kind == "moved"
    assert found.best.numbers == (3,)
    assert found.best.amount == pytest.approx(np.hypot(0.03, 0.03), abs=0.006)


@pytest.mark.slow
def test_a_wrong_focal_length_is_named_with_its_factor(walk):
    cameras, masks = walk
    matrix = np.array(cameras[1].matrix) * [[1.2], [1.2], [1.0]]
    matrix[:2, 2] = cameras[1].matrix[:2, 2]
    zoomed = [cameras[0], replace(cameras[1], matrix=matrix), *cameras[2:]]
    found = contradictions(zoomed, shown_by(zoomed, masks), longest_delay=5)
    assert found.best.kind == "focal length"
    assert found.best.numbers == (1,)
    assert found.best.amount == pytest.approx(1 / 1.2, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("axes", "kind"), [(1, "mirrored"), (0, "upside down"), ((0, 1), "turned")])
def test_flipped_pictures_are_named(walk, axes, kind):
    cameras, masks = walk
    found = contradictions(cameras, shown_by(cameras, masks, flip=(2, axes)))
    assert found.exist
    assert found.best.kind == kind
    assert found.best.numbers == (2,)


@pytest.mark.slow
def test_equal_calibrations_are_named(walk):
    cameras, masks = walk
    same = [cameras[0], replace(cameras[0], name="cam02"), *cameras[2:]]
    found = contradictions(same, shown_by(same, masks))
    assert found.exist
    assert (found.best.kind, found.best.numbers) == ("equal", (1,))
    every = [replace(cameras[0], name=camera.name) for camera in cameras]
    found = contradictions(every, shown_by(every, masks))
    assert found.exist
    assert found.best.numbers == (0, 1, 2, 3)


@pytest.mark.slow
def test_of_two_cameras_no_one_is_blamed_for_a_turn(walk):
    cameras, masks = walk
    pair = [cameras[0], turned(cameras[1], [0.05, 0.0, 0.05])]
    found = contradictions(pair, shown_by(pair, masks[:2]))
    assert found.exist
    blamed = {c for each in (found.best, *found.rivals) for c in each.numbers}
    assert blamed == {0, 1}


def test_differences_grow_with_the_contradiction(walk):
    cameras, masks = walk
    sound = differences_px(cameras, [shown_by(cameras, masks)(c) for c in range(4)])
    late = differences_px(cameras, [shown_by(cameras, masks, late=(0, 9, 0, 0))(c) for c in range(4)])
    usual = {pair: np.nanmedian(np.abs(each)) for pair, each in sound.items()}
    other = {pair: np.nanmedian(np.abs(each)) for pair, each in late.items()}
    assert max(usual.values()) < 1.0
    assert max(value for pair, value in other.items() if 1 in pair) > CONTRADICTION_PX
    assert all(other[pair] == usual[pair] for pair in usual if 1 not in pair)
