"""Lost limbs found again by the colours of the other frames, in painted images."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds
from tests.regions import WORDS, painted

from marey.body.articulation.pose import Pose, PosedBody
from marey.fit.regions.limb_repair import LimbRepairSettings, repaired_limbs
from marey.fit.regions.region_search import RegionSearch, thinned
from marey.fit.search import placements

LOST = 2
SETTINGS = LimbRepairSettings(directions=40, learned_every=1)


@pytest.fixture(scope="module")
def scene():
    body = thinned(worlds.person())
    cameras = tuple(worlds.ring(size=(110, 120), focal=130.0))
    poses = dict(enumerate(worlds.swing(body, 4)))
    rng = np.random.default_rng(4)
    images = {frame: painted(PosedBody(body, pose), cameras, rng) for frame, pose in poses.items()}
    return body, poses, RegionSearch(cameras, WORDS), images


def with_lost_arm(body, pose: Pose) -> Pose:
    angles = np.array(pose.angles)
    names = [coordinate.name for coordinate in body.skeleton.coordinates]
    shoulder = [i for i, name in enumerate(names) if name.startswith("left_shoulder")]
    angles[shoulder] += np.array([0.2, 1.2, 0.0])[: len(shoulder)]
    return replace(pose, angles=angles)


def test_a_lost_limb_is_found_and_nothing_else_changes(scene):
    body, poses, search, images = scene
    given = dict(poses) | {LOST: with_lost_arm(body, poses[LOST])}
    called: list[int] = []
    found = repaired_limbs(search, images.__getitem__, body, given, SETTINGS, progress=called.append)
    assert sorted(called) == list(poses)
    wrist = body.skeleton.segment("left_hand")

    def away(pose: Pose) -> float:
        origin = PosedBody(body, pose).segment_origin[wrist]
        return float(np.linalg.norm(origin - PosedBody(body, poses[LOST]).segment_origin[wrist]))

    # A pixel is 2.5 cm wide.
    assert away(found[LOST]) < 0.05 < 0.3 < away(given[LOST])
    own = placements.limbs_of(body.skeleton)["left_arm"].columns
    others = np.setdiff1d(np.arange(len(body.skeleton) - 6), own)
    np.testing.assert_array_equal(found[LOST].angles[others], given[LOST].angles[others])
    np.testing.assert_array_equal(found[LOST].rotation, given[LOST].rotation)
    np.testing.assert_array_equal(found[LOST].translation, given[LOST].translation)


def test_poses_without_lost_limbs_remain(scene):
    body, poses, search, images = scene
    found = repaired_limbs(search, images.__getitem__, body, poses, SETTINGS)
    assert list(found) == list(poses)
    for frame, pose in poses.items():
        np.testing.assert_array_equal(found[frame].angles, pose.angles)


def test_a_gain_that_nothing_reaches_changes_nothing(scene):
    body, poses, search, images = scene
    given = {LOST: with_lost_arm(body, poses[LOST]), 0: poses[0]}
    found = repaired_limbs(search, images.__getitem__, body, given, replace(SETTINGS, gain=1e6))
    np.testing.assert_array_equal(found[LOST].angles, given[LOST].angles)
