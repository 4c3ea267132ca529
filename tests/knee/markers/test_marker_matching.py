import numpy as np
import pytest

from marey.geometry.rigid import RigidTransform
from marey.knee.markers.marker_matching import MarkerPositions, best_matching, match_group

PLACES = np.array([[-40.0, 0, 10], [35, -20, 20], [0, 40, 45], [20, 30, -15], [-25, -35, 60]])


def markers(places: np.ndarray, sd_mm: float = 0.5) -> MarkerPositions:
    return MarkerPositions(places_mm=places, sd_mm=np.full(len(places), sd_mm))


def any_motion(rng) -> RigidTransform:
    return RigidTransform.from_vector(rng.normal(size=3), rng.normal(0, 100, 3))


def matched(balls: np.ndarray, places: np.ndarray) -> list[list[int]]:
    found = match_group(markers(balls), markers(places), np.ones((len(balls), len(places)), bool))
    return [match.markers.tolist() for match in found]


def chosen(rng, balls: np.ndarray, places: np.ndarray):
    found = match_group(markers(balls), markers(places), np.ones((len(balls), len(places)), bool))
    return best_matching({"femur": found}, np.zeros(3), {"femur": RigidTransform.identity()})


def test_markers_in_any_order_among_others_are_found_again(rng):
    for _ in range(20):
        order = rng.permutation(9)
        others = rng.normal(0, 200, (4, 3))
        places = np.concatenate([any_motion(rng).apply(PLACES) + rng.normal(0, 0.4, PLACES.shape), others])[order]
        assert matched(PLACES, places)[0] == [int(np.flatnonzero(order == ball)[0]) for ball in range(5)]


def test_a_ball_that_the_laboratory_lost_and_a_marker_that_the_scanner_lost_are_left_over(rng):
    places = any_motion(rng).apply(PLACES)
    best = matched(PLACES, places[[4, 2, 1, 0]])
    assert best[0] == [3, 2, 1, -1, 0]
    best = matched(PLACES[:4], places)
    assert best[0] == [0, 1, 2, 3]
    unseen = np.array(places)
    unseen[2] = np.nan
    assert matched(PLACES, unseen)[0] == [0, 1, -1, 3, 4]


def test_a_mirror_image_has_the_same_distances_and_is_no_match(rng):
    places = np.array([[-45.0, -5, 15], [38, -22, 5], [8, 48, 50], [28, 22, -30], [-18, -38, 90]])
    mirrored = any_motion(rng).apply(places * [-1, 1, 1])
    # Three markers have no handedness: at most three fit.
    assert all(sum(marker >= 0 for marker in match) == 3 for match in matched(places, mirrored))


def test_regular_arrangements_are_reported_as_ambiguous(rng):
    square = np.array([[0.0, 0, 0], [50, 0, 0], [50, 50, 0], [0, 50, 0]])
    found = chosen(rng, square, any_motion(rng).apply(square) + rng.normal(0, 0.3, square.shape))
    assert [bone for bone, _ in found.rivals] == ["femur"]
    assert found.rivals[0][1] == (0, 1, 2, 3)
    assert chosen(rng, PLACES, any_motion(rng).apply(PLACES)).rivals == ()


def test_two_nearly_equal_sides_of_a_triangle_are_ambiguous_only_within_the_noise(rng):
    for longer, ambiguous in ((0.5, True), (8.0, False)):
        triangle = np.array([[0.0, 0, 0], [30, 50 + longer, 0], [-30, 50, 0]])
        assert bool(chosen(rng, triangle, any_motion(rng).apply(triangle)).rivals) is ambiguous


def test_of_matches_of_two_bones_those_are_taken_that_make_a_knee(rng):
    femur, tibia = PLACES[:3] + [0, 0, 40.0], np.array([[-30.0, 10, -50], [40, 5, -60], [10, -40, -80]])
    motion = any_motion(rng)
    # A copy of the tibia's markers is a metre away; without the femur it would fit equally well.
    places = np.concatenate([motion.apply(femur), motion.apply(tibia + [1000.0, 0, 0]), motion.apply(tibia)])
    found = {
        bone: match_group(markers(balls), markers(places), np.ones((3, 9), bool))
        for bone, balls in (("femur", femur), ("tibia", tibia))
    }
    assert len(found["tibia"]) > 1
    frames = {bone: RigidTransform.identity() for bone in found}
    best = best_matching(found, np.array([0.0, 0, -5]), frames)
    assert best.rivals == ()
    assert best.groups["femur"].markers.tolist() == [0, 1, 2]
    assert best.groups["tibia"].markers.tolist() == [6, 7, 8]


def test_nothing_that_fits_is_no_match(rng):
    assert matched(PLACES, rng.normal(0, 1000, (5, 3))) == []
    assert chosen(rng, PLACES, rng.normal(0, 1000, (5, 3))).groups == {}


def test_a_given_name_is_kept(rng):
    square = np.array([[0.0, 0, 0], [50, 0, 0], [50, 60, 0], [0, 60, 0]])
    allowed = np.ones((4, 4), bool)
    allowed[0], allowed[:, 2], allowed[0, 2] = False, False, True
    found = match_group(markers(square), markers(square), allowed)
    assert all(match.markers[0] == 2 for match in found)
    assert found[0].markers.tolist() == pytest.approx([2, 3, 0, 1])


def test_how_many_matches_chance_makes_is_about_what_is_counted(rng):
    balls = markers(PLACES[:3])
    expected, seen = [], 0
    for _ in range(150):
        # Nearly on one sphere, so that the spread of their distances is about the assumed one.
        strewn = rng.uniform(-60, 60, (14, 3))
        found = match_group(balls, markers(strewn), np.ones((3, 14), bool))
        seen += len(found)
        expected += [match.by_chance for match in found]
    # The expected number is that of matches at least as good as the best of many draws.
    assert 0.1 < seen / 150 < 10
    assert 0.2 < np.median(expected) / (seen / 150) < 5
