"""Lost limbs found again by the colours of the other frames, in painted images."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds
from tests.regions import WORDS, painted

from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.skeleton import COLOUR_PARTS
from marey.fit.recipes.hypotheses import Alternative, OtherPostures
from marey.fit.regions.limb_repair import (
    LimbRepairSettings,
    repaired_limbs,
    searches,
    uncertain_limbs,
    undetermined_postures,
)
from marey.fit.regions.region_search import RegionSearch, thinned
from marey.fit.search import placements

LOST, BESIDE = 1, 2
RATE = 30.0
NEAR = 0.075
"""Three pixels of the images [m]."""
SETTINGS = LimbRepairSettings(directions=80, learned_every=1)
"""The middle one of each three frames is searched."""


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
    given = dict(poses) | {frame: with_lost_arm(body, poses[frame]) for frame in (LOST, BESIDE)}
    called: list[int] = []
    found = repaired_limbs(search, images.__getitem__, body, given, RATE, SETTINGS, progress=called.append).poses
    assert called == [LOST] * searches(list(given), RATE, SETTINGS)
    wrist = body.skeleton.segment("left_hand")

    def away(frame: int, pose: Pose) -> float:
        origin = PosedBody(body, pose).segment_origin[wrist]
        return float(np.linalg.norm(origin - PosedBody(body, poses[frame]).segment_origin[wrist]))

    own = placements.limbs_of(body.skeleton)["left_arm"].columns
    others = np.setdiff1d(np.arange(len(body.skeleton) - 6), own)
    for frame in (LOST, BESIDE):
        assert away(frame, found[frame]) < NEAR < 0.3 < away(frame, given[frame])
        np.testing.assert_array_equal(found[frame].angles[others], given[frame].angles[others])
        np.testing.assert_array_equal(found[frame].rotation, given[frame].rotation)
        np.testing.assert_array_equal(found[frame].translation, given[frame].translation)
    for frame in set(poses) - {LOST, BESIDE}:
        np.testing.assert_array_equal(found[frame].angles, given[frame].angles)


def test_poses_without_lost_limbs_remain(scene):
    body, poses, search, images = scene
    found = repaired_limbs(search, images.__getitem__, body, poses, RATE, SETTINGS).poses
    assert list(found) == list(poses)
    for frame, pose in poses.items():
        np.testing.assert_array_equal(found[frame].angles, pose.angles)


def test_a_gain_that_nothing_reaches_changes_nothing(scene):
    body, poses, search, images = scene
    given = {0: poses[0], LOST: with_lost_arm(body, poses[LOST])}
    found = repaired_limbs(search, images.__getitem__, body, given, RATE, replace(SETTINGS, least_gain=1e6)).poses
    np.testing.assert_array_equal(found[LOST].angles, given[LOST].angles)


def test_a_limb_that_is_lost_in_all_frames_is_found_by_the_colours_of_the_other_side(scene):
    body, poses, search, images = scene
    given = {frame: with_lost_arm(body, pose) for frame, pose in poses.items()}
    found = repaired_limbs(search, images.__getitem__, body, given, RATE, SETTINGS).poses
    wrist = body.skeleton.segment("left_hand")
    for frame, pose in poses.items():
        origins = [PosedBody(body, each).segment_origin[wrist] for each in (found[frame], pose, given[frame])]
        assert np.linalg.norm(origins[0] - origins[1]) < NEAR < np.linalg.norm(origins[2] - origins[1])


def test_pixels_of_segments_that_are_left_out_are_not_counted(scene):
    body, poses, search, images = scene
    limb = placements.limbs_of(body.skeleton)["left_arm"]
    whole, rest = (search.areas(body, [poses[0]], images[0], without=names)[0] for names in ((), limb.segments))
    assert whole.shape == rest.shape
    counted = [part for part in range(whole.shape[1]) if COLOUR_PARTS[part] in ("upperarm", "forearm", "hand")]
    np.testing.assert_array_equal(np.delete(whole, counted, 1), np.delete(rest, counted, 1))
    assert rest.sum() < whole.sum()


def test_a_limb_that_nothing_shows_has_other_possible_postures(scene):
    body, poses, search, images = scene
    limb = placements.limbs_of(body.skeleton)["left_arm"]
    hidden = {frame: own.without(np.ones(own.words.shape, bool)) for frame, own in images.items()}
    found = repaired_limbs(search, hidden.__getitem__, body, poses, RATE, SETTINGS)
    own = [other for other in found.alternatives if other.name == "left arm"]
    assert own
    for other in own:
        np.testing.assert_array_equal(other.columns, 6 + limb.columns)
        assert SETTINGS.possible <= other.probability <= 1
        for frame, pose in other.poses.items():
            origins = [
                PosedBody(body, each).segment_origin[[body.skeleton.segment(name) for name in limb.segments[1:3]]]
                for each in (pose, found.poses[frame])
            ]
            # The given posture is improved before it is compared.
            assert np.linalg.norm(origins[0] - origins[1], axis=1).mean() > SETTINGS.least_distance - NEAR


def test_a_visible_limb_has_no_other_posture(scene):
    body, poses, search, images = scene
    found = repaired_limbs(search, images.__getitem__, body, poses, RATE, SETTINGS)
    assert not found.replaced
    assert not [other for other in found.alternatives if other.name == "left arm"]


def test_only_the_named_limbs_are_searched(scene):
    body, poses, search, images = scene
    given = dict(poses) | {LOST: with_lost_arm(body, poses[LOST])}
    called: list[int] = []
    found = repaired_limbs(
        search, images.__getitem__, body, given, RATE, SETTINGS, only=("left_leg",), progress=called.append
    )
    assert len(called) == searches(list(given), RATE, SETTINGS, only=("left_leg",)) == 1
    np.testing.assert_array_equal(found.poses[LOST].angles, given[LOST].angles)


def test_limbs_are_searched_again_where_they_or_their_opposites_are_uncertain():
    arm = Alternative("left arm", np.array([6]), {}, 0.2)
    leg = Alternative("right leg", np.array([7]), {}, 0.9)
    assert uncertain_limbs(OtherPostures({})) == ()
    assert uncertain_limbs(OtherPostures({}, alternatives=[arm])) == ("left_arm", "right_arm")
    assert uncertain_limbs(OtherPostures({}, replaced=[leg])) == ("left_leg", "right_leg")


def test_replaced_postures_are_returned_with_their_probability(scene):
    body, poses, search, images = scene
    given = dict(poses) | {frame: with_lost_arm(body, poses[frame]) for frame in (LOST, BESIDE)}
    (former,) = repaired_limbs(search, images.__getitem__, body, given, RATE, SETTINGS).replaced
    assert former.name == "left arm"
    assert list(former.poses) == [LOST, BESIDE]
    assert former.poses[LOST] is given[LOST]
    assert former.probability < 0.5


def test_where_nothing_determines_a_limb_other_postures_are_possible_until_it_is_determined_again(scene):
    body, poses, search, images = scene
    hidden = {frame: own.without(np.ones(own.words.shape, bool)) for frame, own in images.items()}
    calm = dict.fromkeys(poses, poses[0])
    found = undetermined_postures(search, hidden.__getitem__, body, calm, RATE, {"left_arm": [list(calm)]}, SETTINGS)
    assert found
    for other in found:
        assert other.name == "left arm"
        assert SETTINGS.possible <= other.probability <= 1
    # In two frames, an arm does not leave the place where it is determined before and after, and come back.
    assert not undetermined_postures(search, hidden.__getitem__, body, calm, RATE, {"left_arm": [[1, 2]]}, SETTINGS)


def test_what_is_known_beside_the_colours_excludes_other_postures(scene):
    body, poses, search, images = scene
    hidden = {frame: own.without(np.ones(own.words.shape, bool)) for frame, own in images.items()}
    wrist, open_frames = body.skeleton.segment("left_hand"), {"left_arm": [list(poses)], "no_limb": [[0]]}

    def at(frame, pose):
        return PosedBody(body, pose).segment_origin[wrist]

    def support(frame, pose):
        return -0.5 * float(np.sum(((at(frame, pose) - at(frame, poses[frame])) / 0.02) ** 2))

    args = search, hidden.__getitem__, body, poses, RATE, open_frames, SETTINGS
    assert undetermined_postures(*args)
    for other in undetermined_postures(*args, support=support):
        for frame, pose in other.poses.items():
            assert np.linalg.norm(at(frame, pose) - at(frame, poses[frame])) < 0.06
