"""The score of a pose by the classes of the pixels that it covers, and steps of the search with it."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds
from tests.regions import painted

from marey.body.articulation.pose import PosedBody
from marey.cameras.lens import project_points
from marey.fit.regions.region_search import PARTS, NearAngles, RegionSearch, _chains, learned_areas, thinned
from marey.fit.search import placements
from marey.geometry import rotations

COUNT = PARTS + 1
"""Words of the images: one per part, and one of the surroundings."""
BEHIND = PARTS


@pytest.fixture(scope="module")
def scene():
    cameras = tuple(worlds.ring(size=(100, 120), focal=150.0))
    body = worlds.person()
    truth = PosedBody(body, worlds.pose(body))
    return body, truth, RegionSearch(cameras, COUNT), painted(truth, cameras)


def right_table(cameras: int) -> np.ndarray:
    """Log-likelihood ratios that are positive for the right part only."""
    table = np.full((cameras, PARTS, COUNT), -1.0)
    table[:, np.arange(PARTS), np.arange(PARTS)] = 1.0
    return table


def test_the_words_of_the_parts_are_those_that_a_depth_buffer_shows(scene):
    body, truth, search, images = scene
    areas = search.areas(body, [truth.pose], images)[0]
    for c, camera in enumerate(search.cameras):
        projected = np.empty_like(truth.vertices)
        project_points(camera.packed, truth.vertices, projected)
        pixel = 1.0 / np.mean(camera.matrix[0, 0] * projected[::7, 2]) ** 2
        drawn = np.bincount(images.words[c].ravel(), minlength=COUNT)
        assert areas[c].sum() == pytest.approx(drawn[:PARTS].sum() * pixel, rel=1e-4)
        # Faces have one depth each here, so that a few pixels beside the edges of parts differ.
        assert np.trace(areas[c]) > 0.97 * areas[c].sum()


def test_a_score_is_the_ratio_times_the_area_less_the_cost_of_the_angles(scene):
    body, truth, search, images = scene
    flat = np.full((len(search.cameras), PARTS, COUNT), 0.7)
    extra = replace(images, evidence=np.full(images.words.shape, 0.2))
    nothing = float(search.scores(body, [truth.pose], images, 0 * flat)[0])
    area = float(search.areas(body, [truth.pose], images).sum())
    assert search.scores(body, [truth.pose], extra, flat)[0] - nothing == pytest.approx(0.9 * area, rel=1e-4)
    mean, sd = body.skeleton.habit
    low, high = body.skeleton.limits.T
    angles = truth.pose.angles
    beyond = np.minimum(angles - low, 0) + np.maximum(angles - high, 0)
    cost = np.sum(((angles - mean) / sd) ** 2) + np.sum((beyond / search.settings.excess_sd) ** 2)
    assert nothing == pytest.approx(-search.settings.habit_weight * cost, rel=1e-6)


def test_the_score_of_shared_words_compares_each_camera_with_the_others(scene, rng):
    body, truth, search, images = scene
    images = replace(images, evidence=rng.normal(size=images.words.shape))
    poses, least, share = [truth.pose, truth.pose.step(rng.normal(size=len(body.skeleton)) * 0.1)], 0.02, 0.95
    areas = search.areas(body, poses, images).astype(float)
    nothing = np.zeros((len(search.cameras), PARTS, COUNT))
    expected = search.scores(body, poses, images, nothing)
    for c in range(len(search.cameras)):
        whole = search.counts(images.words[c]) + 1.0
        others = areas.sum(axis=1) - areas[:, c] + least
        density = share * others / others.sum(axis=-1, keepdims=True) + (1 - share) / COUNT
        expected = expected + np.sum(areas[:, c] * (np.log(density) - np.log(whole / whole.sum())), axis=(1, 2))
    found = search.shared_scores(body, poses, images, least_area=least, other_share=share)
    # The areas of the plain formula are single precision.
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert found[0] != found[1]


def test_the_true_pose_has_the_best_score_of_many(scene, rng):
    body, truth, search, images = scene
    others = [truth.pose.step(rng.normal(size=len(body.skeleton)) * 0.1) for _ in range(20)]
    scores = search.scores(body, [truth.pose, *others], images, right_table(len(search.cameras)))
    assert scores[0] > scores[1:].max()


@pytest.mark.parametrize("whole", [True, False])
def test_both_ways_to_improve_a_pose_come_back_to_the_true_one(scene, rng, whole):
    body, truth, search, images = scene
    table = right_table(len(search.cameras))
    start = replace(truth, pose=truth.pose.step(rng.normal(size=len(body.skeleton)) * 0.05))
    before = float(search.scores(body, [start.pose], images, table)[0])

    def improved(posed):
        if whole:
            return search.fit(posed, images, table)
        return search.climb(posed, images, table, (0.1, 0.06, 0.03, 0.02), np.arange(len(body.skeleton)))

    after, pose = improved(replace(start, pose=improved(start)[1]))
    assert after > before
    # Areas are added up in another order.
    assert after == pytest.approx(float(search.scores(body, [pose], images, table)[0]), rel=1e-6)

    def error(posed):
        return np.linalg.norm(posed.segment_origin - truth.segment_origin, axis=1).mean()

    # A pixel is 2 cm wide at the body.
    assert error(replace(truth, pose=pose)) < min(0.01 if whole else 0.02, 0.5 * error(start))


def test_a_fit_finds_a_body_that_is_displaced_by_many_pixels(scene):
    body, truth, search, images = scene
    step = np.zeros(len(body.skeleton))
    step[:3] = 0.1, -0.08, 0.05
    start = replace(truth, pose=truth.pose.step(step))
    _, pose = search.fit(start, images, right_table(len(search.cameras)))
    assert np.linalg.norm(pose.translation - truth.pose.translation) < 0.01


def test_a_fit_never_lowers_the_score(scene, rng):
    body, truth, search, images = scene
    for _ in range(5):
        table = rng.normal(size=(len(search.cameras), PARTS, COUNT))
        start = replace(truth, pose=truth.pose.step(rng.normal(size=len(body.skeleton)) * 0.2))
        before = float(search.scores(body, [start.pose], images, table)[0])
        after, pose = search.fit(start, images, table)
        assert after >= before - 1e-6 * abs(before)
        assert np.isfinite(pose.angles).all()


def test_a_fit_leaves_a_body_that_no_camera_sees(scene):
    _, truth, search, images = scene
    mean = truth.body.skeleton.habit[0]
    far = replace(truth, pose=replace(truth.pose, translation=np.array([0.0, 0.0, 1e3]), angles=mean))
    score, pose = search.fit(far, images, right_table(len(search.cameras)))
    assert score == 0.0
    np.testing.assert_allclose(pose.angles, mean, atol=1e-9)
    np.testing.assert_array_equal(pose.translation, far.pose.translation)


def test_a_prediction_holds_angles_that_nothing_else_determines(scene):
    body, truth, search, images = scene
    nothing = np.zeros((len(search.cameras), PARTS, COUNT))
    low, high = body.skeleton.limits.T
    wanted = np.clip(truth.pose.angles + 0.1, low, high)
    free = search.fit(truth, images, nothing)[1]
    held = search.fit(truth, images, nothing, NearAngles(wanted, np.full(len(wanted), 1e-3)))[1]
    assert np.abs(held.angles - wanted).max() < 1e-3
    assert np.abs(free.angles - wanted).max() > 0.1


def test_a_misplaced_arm_is_found_by_the_search_of_limbs(scene):
    body, truth, search, images = scene
    angles = np.array(truth.pose.angles)
    names = [coordinate.name for coordinate in body.skeleton.coordinates]
    own = [i for i, name in enumerate(names) if name.startswith("left_shoulder")]
    angles[own] = angles[own] + np.array([0.0, 1.2, 0.0])[: len(own)]
    wrong = replace(truth, pose=replace(truth.pose, angles=angles))
    found = replace(truth, pose=search.limbs(wrong, images, right_table(len(search.cameras)), directions=60))
    elbow = body.skeleton.segment("left_forearm")

    def away(posed):
        return np.linalg.norm(posed.segment_origin[elbow] - truth.segment_origin[elbow])

    assert away(found) < 0.5 * away(wrong)


def test_learned_words_speak_for_their_part_and_against_the_surroundings(scene):
    body, truth, search, images = scene
    areas = learned_areas(search, body, {3: truth.pose, 5: truth.pose}, {3: images})
    assert list(areas) == [3]
    table = search.word_table(areas[3], truth, images, whole_share=0.1)
    assert (table[:, :, BEHIND] < 0).all()
    seen = areas[3].sum(axis=(0, 2)) > 0.01
    own = table[:, np.arange(PARTS), np.arange(PARTS)]
    assert (own[:, seen] > 0).all()
    densities = search.part_densities(areas[3], whole_share=0.1)
    np.testing.assert_allclose(densities[:, seen].sum(axis=-1), 1.0, atol=1e-6)


def test_words_of_the_surroundings_are_removed_from_those_of_the_parts(scene):
    body, truth, search, images = scene
    own = learned_areas(search, body, {3: truth.pose}, {3: images})[3]
    around = search.surroundings(truth, images)
    # A third of what was taken for the part shows the surroundings.
    mixed = own + 0.5 * own.sum(axis=-1, keepdims=True) * around[:, None]
    found = search.own_areas(mixed, around, whole_share=0.1)
    seen = own.sum(axis=-1) > 0.01
    before, after = ((areas[..., BEHIND] / np.maximum(areas.sum(axis=-1), 1e-12))[seen] for areas in (mixed, found))
    assert (after < 0.5 * before).all()
    kept = np.take_along_axis(found, own.argmax(axis=-1)[..., None], axis=-1)[..., 0]
    assert (kept[seen] > 0.9 * own.max(axis=-1)[seen]).all()


def test_parts_that_look_like_the_surroundings_keep_their_words(scene):
    _, _, search, _ = scene
    around = np.full((len(search.cameras), COUNT), 1.0 / COUNT)
    alike = np.tile(around[:, None], (1, PARTS, 1))
    found = search.own_areas(alike, around, whole_share=0.1)
    np.testing.assert_allclose(found / found.sum(axis=-1, keepdims=True), alike, rtol=1e-9)


def test_a_body_with_fewer_faces_keeps_its_skeleton_and_nearly_its_area(scene):
    body, truth, search, images = scene
    fewer = thinned(body, cell=0.08)
    assert len(fewer.vertices) < 0.8 * len(body.vertices)
    np.testing.assert_array_equal(fewer.joint_centres, body.joint_centres)
    shifted = body.numbers + 0.1
    np.testing.assert_allclose(fewer.with_numbers(shifted).joint_centres, body.with_numbers(shifted).joint_centres)
    few, many = (search.areas(b, [truth.pose], images).sum() for b in (fewer, body))
    assert 0.9 * many < few < 1.02 * many


def test_a_body_outside_all_images_has_no_area(scene):
    body, truth, search, images = scene
    away = replace(truth.pose, translation=truth.pose.translation + [0, 0, 50.0])
    turned = replace(truth.pose, rotation=rotations.about(np.array([0.0, 0.0, 1.0]), 1.0))
    areas = search.areas(body, [away, turned], images)
    assert areas[0].sum() == 0
    assert areas[1].sum() > 0


def test_scores_of_single_limbs_are_those_of_whole_bodies(scene, rng):
    body, truth, search, images = scene
    table = rng.normal(size=(len(search.cameras), PARTS, COUNT))
    images = replace(images, evidence=rng.normal(size=images.words.shape))
    names = [coordinate.name for coordinate in body.skeleton.coordinates]
    for side, segment in (("left_shoulder", "left_upperarm"), ("right_hip", "right_thigh")):
        own = [i for i, name in enumerate(names) if name.startswith(side)]
        angles = np.tile(truth.pose.angles, (3, 1))
        angles[:, own] += np.array([0.0, 0.3, -0.4])[:, None]
        tries = [replace(truth.pose, angles=each) for each in angles]
        found = search._limb_scores(truth, body.skeleton.segment(segment), angles, images, table)
        assert np.ptp(found) > 1e-3
        # The ratios of the pixels are single precision, and the larger ones of the layer are added and taken away.
        np.testing.assert_allclose(found, search.scores(body, tries, images, table), rtol=1e-6)


def test_a_chain_moves_what_its_coordinates_move(scene):
    body, truth, _, _ = scene
    chain, faces, vertices = _chains(body)
    for i in range(len(body.skeleton)):
        step = np.zeros(len(body.skeleton))
        step[i] = 0.1
        moved = np.abs(PosedBody(body, truth.pose.step(step)).vertices - truth.vertices).max(axis=1) > 1e-9
        assert not (moved & ~vertices[chain[i]]).any()
        assert not (moved[body.faces].any(axis=1) & ~faces[chain[i]]).any()
    names = np.array(body.skeleton.segment_names)
    assert {"left_clavicle", "right_clavicle", "left_thigh", "right_thigh"} <= set(names[chain])
    assert not {"left_hand", "right_foot"} & set(names[chain])


def test_only_the_named_limbs_and_coordinates_change(scene, rng):
    body, truth, search, images = scene
    table = right_table(len(search.cameras))
    start = replace(truth, pose=truth.pose.step(rng.normal(size=len(body.skeleton)) * 0.2))
    own = placements.limbs_of(body.skeleton)["right_leg"].columns
    for pose in (
        search.limbs(start, images, table, directions=30, only=("right_leg",)),
        search.climb(start, images, table, (0.1, 0.05), 6 + own)[1],
    ):
        changed = np.flatnonzero(pose.angles != start.pose.angles)
        assert len(changed)
        assert set(changed) <= set(own)
        np.testing.assert_array_equal(pose.translation, start.pose.translation)
        np.testing.assert_array_equal(pose.rotation, start.pose.rotation)
