"""The skin of a fitted body as the cameras see it."""

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.fit.solver.picture_times import PictureTimes
from marey.io.stages import FrameLog
from marey.pipelines.silhouettes import drawn_surface
from marey.pipelines.silhouettes.mask_store import MaskStore


def test_the_surface_is_drawn_where_a_pose_is_known_and_compared_with_what_was_seen(tmp_path):
    cameras, body = worlds.ring(2), worlds.person()
    poses = {3: worlds.pose(body), 4: worlds.pose(body, yaw=1.0), 5: worlds.pose(body, at=(0, 0, 50))}
    drawn = drawn_surface.surface_masks(drawn_surface.PosedSkin.of(body, poses), poses, cameras)
    assert drawn(2) is None
    with FrameLog(tmp_path / "masks.log") as log:
        store = MaskStore(log, 3, cameras)
        store.append(drawn(3))
        half = [mask & (np.arange(mask.shape[1]) < mask.shape[1] // 2) for mask in drawn(4)]
        store.append(half)
        store.append([np.zeros_like(mask) for mask in half])
        steps = []
        agreement = drawn_surface.agreements(drawn, poses, store, done=lambda: steps.append(1))
    np.testing.assert_array_equal(agreement[3], 1.0)
    shares = [h.sum() / d.sum() for h, d in zip(half, drawn(4), strict=True)]
    np.testing.assert_allclose(agreement[4], shares)
    # Neither the surface nor a silhouette is in the image.
    assert np.isnan(agreement[5]).all()
    assert len(steps) == 3


def test_skins_and_what_is_seen_of_them_have_a_row_for_each_frame():
    cameras, body = worlds.ring(2), worlds.person()
    poses = {1: worlds.pose(body)}
    skins = list(drawn_surface.skins(drawn_surface.PosedSkin.of(body, poses), list(poses), 3))
    assert len(skins) == 3
    assert np.isnan(skins[0]).all()
    np.testing.assert_array_equal(skins[1], PosedBody(body, poses[1]).vertices)
    seen = list(drawn_surface.seen_vertices(drawn_surface.PosedSkin.of(body, poses), list(poses), cameras, 3))
    assert not seen[0].any()
    assert not seen[2].any()
    assert 0.05 < seen[1].mean() < 0.8


def test_a_late_picture_shows_the_pose_that_the_body_has_then():
    cameras, body = worlds.ring(2), worlds.person()
    poses = {frame: worlds.pose(body, at=(0.2 * frame, 0, 0)) for frame in range(3)}
    times = PictureTimes(np.array([[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]]))
    drawn = drawn_surface.surface_masks(drawn_surface.PosedSkin.of(body, poses, times), poses, cameras)
    at_frames = drawn_surface.surface_masks(drawn_surface.PosedSkin.of(body, poses), poses, cameras)
    half = {1: worlds.pose(body, at=(0.3, 0, 0))}
    later = drawn_surface.surface_masks(drawn_surface.PosedSkin.of(body, half), half, cameras)
    np.testing.assert_array_equal(drawn(1)[0], at_frames(1)[0])
    np.testing.assert_array_equal(drawn(1)[1], later(1)[1])
    assert (drawn(1)[1] != at_frames(1)[1]).any()


def test_hidden_pixels_do_not_count_for_the_agreement_and_are_reported(tmp_path):
    cameras, body = worlds.ring(2), worlds.person()
    poses = {3: worlds.pose(body)}
    drawn = drawn_surface.surface_masks(drawn_surface.PosedSkin.of(body, poses), poses, cameras)
    left = [np.broadcast_to(np.arange(mask.shape[1]) < mask.shape[1] // 2, mask.shape) for mask in drawn(3)]
    behind = [left[0], np.zeros_like(left[1])]
    with FrameLog(tmp_path / "masks.log") as log:
        store = MaskStore(log, 3, cameras)
        store.append([mask & ~hidden for mask, hidden in zip(drawn(3), behind, strict=True)], hidden=behind)
        agreement = drawn_surface.agreements(drawn, poses, store, done=lambda: None)
        names = [camera.name for camera in cameras]
        shares = drawn_surface.hidden_shares(drawn, [3], store, None, names)
    np.testing.assert_array_equal(agreement[3], 1.0)
    own = drawn(3)[0]
    assert shares[names[0]].person == pytest.approx(np.count_nonzero(own & left[0]) / np.count_nonzero(own))
    assert shares[names[1]].person == 0.0
    assert shares[names[0]].image == 0.0
