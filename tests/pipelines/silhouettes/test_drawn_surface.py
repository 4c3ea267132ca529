"""The skin of a fitted body as the cameras see it."""

from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.cameras.rig import Rig
from marey.fit.solver.picture_times import PictureTimes
from marey.io.stages import FrameLog
from marey.io.trial.masks import open_masks
from marey.pipelines.silhouettes import drawn_surface
from marey.pipelines.silhouettes.drawn_surface import PosedSkin, on_rim
from marey.pipelines.silhouettes.mask_store import MaskStore


def trial_of(cameras, count):
    return SimpleNamespace(rig=Rig(tuple(cameras)), take=SimpleNamespace(count=count))


def masks_of(skin, frame, cameras):
    return [skin.seen_by(camera, frame, c).mask() for c, camera in enumerate(cameras)]


@contextmanager
def stored(path, cameras, silhouettes, hidden=()):
    """Open a store of silhouettes that begins at frame 3."""
    with FrameLog(path / "masks.log") as log:
        store = MaskStore(log, 3, cameras)
        for masks in silhouettes:
            store.append(masks, hidden=hidden)
        yield store


def test_the_surface_is_drawn_where_a_pose_is_known_and_compared_with_what_was_seen(tmp_path):
    cameras, body = worlds.ring(2), worlds.person()
    poses = {3: worlds.pose(body), 4: worlds.pose(body, yaw=1.0), 5: worlds.pose(body, at=(0, 0, 50))}
    skin, trial = PosedSkin.of(body, poses), trial_of(cameras, 7)
    whole = masks_of(skin, 4, cameras)
    half = [mask & (np.arange(mask.shape[1]) < mask.shape[1] // 2) for mask in whole]
    steps = []
    with stored(tmp_path, cameras, [masks_of(skin, 3, cameras), half, [np.zeros_like(m) for m in half]]) as store:
        found = drawn_surface.draw_skin(skin, poses, trial, store, folder=tmp_path, done=lambda: steps.append(1))
        drawn_surface.write_silhouettes(tmp_path, trial, store)
    np.testing.assert_array_equal(found.agreement[3], 1.0)
    shares = [h.sum() / d.sum() for h, d in zip(half, whole, strict=True)]
    np.testing.assert_allclose(found.agreement[4], shares)
    # Neither the surface nor a silhouette is in the image.
    assert np.isnan(found.agreement[5]).all()
    assert found.hidden == {}
    assert len(steps) == 3
    for c, camera in enumerate(cameras):
        drawn = list(open_masks(tmp_path / "surface_masks" / f"{camera.name}.npz").masks())
        silhouettes = list(open_masks(tmp_path / "masks" / f"{camera.name}.npz").masks())
        np.testing.assert_array_equal(drawn[4], whole[c])
        np.testing.assert_array_equal(silhouettes[4], half[c])
        assert [bool(mask.any()) for mask in drawn] == [frame in (3, 4) for frame in range(7)]
        assert [bool(mask.any()) for mask in silhouettes] == [frame in (3, 4) for frame in range(7)]


def test_skins_and_what_is_seen_of_them_have_a_row_for_each_frame(tmp_path):
    cameras, body = worlds.ring(2), worlds.person()
    poses = {3: worlds.pose(body)}
    skin = PosedSkin.of(body, poses)
    skins = list(drawn_surface.skins(skin, poses, 5))
    assert len(skins) == 5
    assert np.isnan(skins[0]).all()
    np.testing.assert_array_equal(skins[3], PosedBody(body, poses[3]).vertices)
    with stored(tmp_path, cameras, [masks_of(skin, 3, cameras)]) as store:
        seen = list(drawn_surface.draw_skin(skin, poses, trial_of(cameras, 5), store, folder=tmp_path).seen_vertices(5))
    assert [bool(row.any()) for row in seen] == [frame == 3 for frame in range(5)]
    np.testing.assert_array_equal(seen[3], on_rim(skin, 3, cameras))
    assert 0.05 < seen[3].mean() < 0.8


def test_a_late_picture_shows_the_pose_that_the_body_has_then():
    cameras, body = worlds.ring(2), worlds.person()
    poses = {frame: worlds.pose(body, at=(0.2 * frame, 0, 0)) for frame in range(3)}
    times = PictureTimes(np.array([[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]]))
    drawn = masks_of(PosedSkin.of(body, poses, times), 1, cameras)
    at_frames = masks_of(PosedSkin.of(body, poses), 1, cameras)
    later = masks_of(PosedSkin.of(body, {1: worlds.pose(body, at=(0.3, 0, 0))}), 1, cameras)
    np.testing.assert_array_equal(drawn[0], at_frames[0])
    np.testing.assert_array_equal(drawn[1], later[1])
    assert (drawn[1] != at_frames[1]).any()


def test_hidden_pixels_do_not_count_for_the_agreement_and_are_reported(tmp_path):
    cameras, body = worlds.ring(2), worlds.person()
    poses = {3: worlds.pose(body)}
    skin, trial = PosedSkin.of(body, poses), trial_of(cameras, 4)
    drawn = masks_of(skin, 3, cameras)
    left = [np.broadcast_to(np.arange(mask.shape[1]) < mask.shape[1] // 2, mask.shape) for mask in drawn]
    behind = [left[0], np.zeros_like(left[1])]
    seen = [mask & ~hidden for mask, hidden in zip(drawn, behind, strict=True)]
    with stored(tmp_path, cameras, [seen], behind) as store:
        found = drawn_surface.draw_skin(skin, poses, trial, store, folder=tmp_path)
    np.testing.assert_array_equal(found.agreement[3], 1.0)
    first, second = (found.hidden[camera.name] for camera in cameras)
    assert first.person == pytest.approx(np.count_nonzero(drawn[0] & left[0]) / np.count_nonzero(drawn[0]))
    assert second.person == 0.0
    assert first.image == 0.0
