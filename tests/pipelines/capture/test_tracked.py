"""A tracked person as arrays."""

import numpy as np
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.fit.recipes.person import PersonSettings
from marey.fit.search.search import Search
from marey.io.stages import load_arrays, save_arrays
from marey.pipelines.capture.tracked import pack_candidates, pack_tracked, unpack_tracked


def test_poses_scores_and_sizes_are_the_same_after_saving(tmp_path, rng):
    body = worlds.person()
    body = body.with_numbers(0.3 * rng.normal(size=len(body.space)))
    poses = {frame: worlds.pose(body, yaw=0.1 * frame, at=(0.01 * frame, 0, 0)) for frame in (3, 4, 9)}
    scores = {3: 0.9, 4: 0.8, 9: 0.95}
    save_arrays(tmp_path / "tracked.npz", pack_tracked(poses, body, scores))
    found = unpack_tracked(load_arrays(tmp_path / "tracked.npz"), worlds.person())
    assert found.scores == scores
    np.testing.assert_allclose(found.body.vertices, body.vertices, atol=1e-12)
    assert list(found.poses) == list(poses)
    for frame, pose in poses.items():
        np.testing.assert_array_equal(found.poses[frame].angles, pose.angles)
        np.testing.assert_array_equal(found.poses[frame].translation, pose.translation)
        np.testing.assert_allclose(found.poses[frame].rotation, pose.rotation, atol=1e-12)


def test_candidates_are_packed_with_their_scores():
    body = worlds.scan()
    posed = PosedBody(body, worlds.pose(body))
    take = worlds.take([posed], worlds.ring(2))
    candidate = Search(take.levels(160.0).at(0), PersonSettings().start).judge(posed)
    arrays = pack_candidates({5: candidate}, body)
    assert arrays["frames"].tolist() == [5]
    assert arrays["score"].tolist() == [candidate.score]
