"""The kernels that compare many poses, against the plain way for one pose."""

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import Pose, PosedBody
from marey.fit.search import cover, placements
from marey.fit.search.levels import SilhouetteLevel
from marey.fit.search.search import Search, StartSettings, limb_directions


@pytest.fixture(scope="module")
def scene():
    cameras = worlds.ring(size=(100, 120), focal=150.0)
    body = worlds.person()
    truth = PosedBody(body, worlds.pose(body))
    return body, cameras, SilhouetteLevel.at_size(cameras, worlds.silhouettes(truth, cameras))


def overlap(body, poses, level):
    """Mean intersection over union by the rasteriser with a depth buffer."""
    scores = []
    for pose in poses:
        drawn = worlds.silhouettes(PosedBody(body, pose), level.cameras)
        pairs = zip(drawn, level.masks, strict=True)
        scores.append(np.mean([np.count_nonzero(a & b) / np.count_nonzero(a | b) for a, b in pairs]))
    return np.array(scores)


def test_scores_are_the_mean_overlap_of_what_the_cameras_see(scene, rng):
    body, _, level = scene
    truth = worlds.pose(body)
    poses = [truth.step(rng.normal(size=len(body.skeleton)) * spread) for spread in (0, 0.02, 0.1, 0.3, 0.5)]
    scores = Search(level, StartSettings()).score(body, poses)
    np.testing.assert_allclose(scores, overlap(body, poses, level), atol=1e-12)
    assert scores[0] == 1.0


def test_a_body_outside_all_images_scores_zero_and_empty_images_score_one(scene):
    body, cameras, level = scene
    away = worlds.pose(body, at=(0, 0, 50))
    assert Search(level, StartSettings()).score(body, [away])[0] == 0.0
    empty = SilhouetteLevel.at_size(cameras, [np.zeros_like(mask) for mask in level.masks])
    assert Search(empty, StartSettings()).score(body, [away])[0] == 1.0


@pytest.mark.parametrize("name", placements.SEARCHED_LIMBS)
def test_a_moved_limb_scores_as_the_whole_moved_body(scene, rng, name):
    body, _, level = scene
    search = Search(level, StartSettings())
    pose = worlds.pose(body).step(rng.normal(size=len(body.skeleton)) * 0.05)
    limb = placements.limb_of(body.skeleton, name)
    arm, leg = limb_directions(body)
    every = placements.limb_placements(body.skeleton, limb, arm if "arm" in name else leg, count=12)
    candidates = np.ascontiguousarray(every[::3])
    own = np.isin(body.face_segment, [body.skeleton.segment(s) for s in limb.segments])
    rest = (*body.packed, body.joint_centres, body.vertices, body.vertex_segments, body.vertex_weights)
    scores = cover.score_limb(
        *rest, body.faces[own], body.faces[~own], np.unique(body.faces[own]),
        pose.rotation, pose.translation, pose.angles, limb.columns, candidates, *search.packed,
    )  # fmt: skip
    moved = []
    for row in candidates:
        angles = np.array(pose.angles)
        angles[limb.columns] = row
        moved.append(Pose(pose.translation, pose.rotation, angles))
    whole = search.score(body, moved)
    # Faces of the trunk that also hang on the limb stay where they were: a few pixels in some thousand.
    np.testing.assert_allclose(scores, whole, atol=0.02)
    assert np.corrcoef(scores, whole)[0, 1] > 0.99


def test_hidden_pixels_count_neither_for_nor_against_a_pose(scene, rng):
    body, cameras, level = scene
    hidden = [np.zeros_like(mask) for mask in level.masks]
    for each in hidden:
        each[70:] = True
    seen = [mask & ~each for mask, each in zip(level.masks, hidden, strict=True)]
    behind = Search(SilhouetteLevel.at_size(cameras, seen, hidden=hidden), StartSettings())
    truth = worlds.pose(body)
    poses = [truth, truth.step(rng.normal(size=len(body.skeleton)) * 0.1)]
    scores = behind.score(body, poses)
    assert scores[0] == 1.0
    shares = []
    for mask, each, drawn in zip(seen, hidden, worlds.silhouettes(PosedBody(body, poses[1]), cameras), strict=True):
        shares.append(np.count_nonzero(drawn & mask) / np.count_nonzero((drawn & ~each) | mask))
    assert scores[1] == pytest.approx(np.mean(shares), abs=1e-12)
    # Without the knowledge of what is hidden, the true pose scores less.
    assert Search(SilhouetteLevel.at_size(cameras, seen), StartSettings()).score(body, [truth])[0] < 0.9
