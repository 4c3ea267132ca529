"""Things in front of a made body that steps aside, in true silhouettes."""

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.images.silhouettes.occluders import OccluderSettings
from marey.pipelines.occlusion import occluders
from marey.pipelines.occlusion.occluders import BodyTake, Occluders, find_occluders

FRAMES = range(3, 15)


@pytest.fixture(scope="module")
def steps():
    cameras, body = worlds.ring(), worlds.person()
    poses = {frame: worlds.pose(body, at=(0.02 * frame, 0.03 * frame, 0)) for frame in FRAMES}
    masks = {frame: worlds.silhouettes(PosedBody(body, pose), cameras) for frame, pose in poses.items()}
    return BodyTake(cameras, body, poses), masks


def bar(camera):
    """A bar across the image at the height of the thighs."""
    thing = np.zeros((camera.height, camera.width), bool)
    thing[140:165] = True
    return thing


def found_with(steps, things, unknown=lambda frame: None):
    take, masks = steps
    seen = {f: [m & ~things[c] if c in things else m for c, m in enumerate(every)] for f, every in masks.items()}
    return find_occluders(take, seen.__getitem__, unknown, OccluderSettings()), seen


def test_nothing_is_found_where_nothing_hides_the_body(steps):
    found, _ = found_with(steps, {})
    assert not found.any


@pytest.mark.slow
def test_things_before_one_and_two_cameras_are_found(steps):
    take, masks = steps
    for numbers in ((0,), (1, 2)):
        things = {c: bar(take.cameras[c]) for c in numbers}
        found, seen = found_with(steps, things)
        hidden = found.hidden_in(take, seen.__getitem__)
        assert hidden(0) is None
        for c in range(4):
            cut = [masks[f][c] & ~seen[f][c] for f in FRAMES]
            share = sum(np.count_nonzero(a & hidden(f)[c]) for a, f in zip(cut, FRAMES, strict=True))
            lost = sum(np.count_nonzero(seen[f][c] & hidden(f)[c]) for f in FRAMES)
            assert share >= 0.9 * sum(map(np.count_nonzero, cut))
            assert lost == 0
            assert (found.things[c].share > 0) == (c in numbers)


def test_large_images_are_reduced_and_the_things_are_the_same(steps, monkeypatch):
    take, _ = steps
    whole, _ = found_with(steps, {0: bar(take.cameras[0])})
    monkeypatch.setattr(occluders, "LOOKED_PX", take.cameras[0].height // 2)
    found, _ = found_with(steps, {0: bar(take.cameras[0])})
    assert found.things[0].nearest_m.shape[0] == take.cameras[0].height // 2
    # The rows above and below the bar, which has 25, may differ by a pixel of the reduced images.
    assert found.things[0].share == pytest.approx(whole.things[0].share, rel=0.2)
    assert not any(thing.share for thing in found.things[1:])


def test_images_that_say_nothing_are_no_evidence(steps):
    take, _ = steps
    everywhere = [np.ones((camera.height, camera.width), bool) for camera in take.cameras]
    found, _ = found_with(steps, {0: bar(take.cameras[0])}, lambda frame: everywhere)
    assert not found.any


def test_a_part_that_the_other_cameras_do_not_show_is_no_evidence(steps):
    take, masks = steps
    # A wrong pose of the body: nothing of it is where the silhouettes are.
    away = {frame: worlds.pose(take.body, at=(0.5, -0.4, 0)) for frame in FRAMES}
    moved = BodyTake(take.cameras, take.body, away)
    assert not find_occluders(moved, masks.__getitem__, lambda frame: None, OccluderSettings()).any


def test_things_are_the_same_after_storage(steps):
    take, _ = steps
    found, _ = found_with(steps, {0: bar(take.cameras[0])})
    again = Occluders.unpacked(found.packed())
    for one, other in zip(found.things, again.things, strict=True):
        np.testing.assert_array_equal(one.nearest_m, other.nearest_m)
