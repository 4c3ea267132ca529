import numpy as np

from marey.geometry import rotations
from marey.surface.tracks.local_motion import LocalMotionSettings, carried, moved_rigidly, neighbours_of, radius_of


def cloud(rng, count=60):
    return rng.uniform(-0.05, 0.05, (count, 3))


def moved_by_formula(places, start, end, used, least):
    """Positions moved by the best rotation of a singular value decomposition, and the spread of the neighbours."""
    moved, spread = np.full((len(places), 3), np.nan), np.full(len(places), np.nan)
    for n in np.flatnonzero(2 * used.sum(axis=1) >= least):
        first, last = start[n, used[n]], end[n, used[n]]
        apart = np.linalg.norm(last - first - np.median(last - first, axis=0), axis=1)
        first, last = (np.delete(side, apart.argmax(), axis=0) for side in (first, last))
        back, out = first - first.mean(axis=0), last - last.mean(axis=0)
        left, _, right = np.linalg.svd(out.T @ back)
        turn = left @ np.diag([1, 1, np.sign(np.linalg.det(left @ right))]) @ right
        moved[n] = last.mean(axis=0) + turn @ (places[n] - first.mean(axis=0))
        spread[n] = np.sqrt(np.sum((out - back @ turn.T) ** 2) / (3 * len(first) - 6))
    return moved, spread


def test_the_kernel_is_the_plain_formula(rng):
    start = rng.uniform(-0.05, 0.05, (200, 9, 3))
    turn = rotations.exp(rng.normal(size=(200, 3)))
    end = start @ np.swapaxes(turn, 1, 2) + rng.normal(0, 3e-3, start.shape)
    used = rng.random((200, 9)) < 0.7
    places, settings = rng.uniform(-0.05, 0.05, (200, 3)), LocalMotionSettings(neighbours=10)
    start[~used] = np.nan
    found, expected = moved_rigidly(places, start, end, used, settings), moved_by_formula(places, start, end, used, 10)
    assert 5 < np.isnan(expected[1]).sum() < 100
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


def test_places_move_with_a_rigid_surface(rng):
    points, places = cloud(rng), cloud(rng, 7)
    turn, shift = rotations.exp(np.array([0.3, -0.2, 0.5])), np.array([0.4, 0.0, -0.1])
    moved = carried(places, points, points @ turn.T + shift, radius=0.2)
    np.testing.assert_allclose(moved, places @ turn.T + shift, atol=1e-12)


def test_one_false_neighbour_does_no_harm(rng):
    points, places = cloud(rng, 8), cloud(rng, 3)
    after = points + [0.01, 0.0, 0.0]
    after[5] += [0.0, 0.3, 0.0]
    moved = carried(places, points, after, radius=0.5)
    np.testing.assert_allclose(moved, places + [0.01, 0.0, 0.0], atol=1e-12)


def test_a_mirrored_surface_is_no_motion(rng):
    points = cloud(rng, 8)[None]
    _, spread = moved_rigidly(np.zeros((1, 3)), points, points * [-1, 1, 1], np.ones((1, 8), bool))
    assert spread[0] > 0.005


def test_the_spread_is_the_noise_of_the_neighbours(rng):
    points = np.broadcast_to(cloud(rng, 8), (4000, 8, 3))
    noisy = points + rng.normal(0, 1e-4, points.shape)
    _, spread = moved_rigidly(np.zeros((4000, 3)), points, noisy, np.ones((4000, 8), bool))
    # The worst of the eight is left out, so that a little less remains.
    assert 0.75e-4 < np.sqrt(np.mean(spread**2)) < 1.0e-4


def test_the_settings_are_the_number_and_the_distance_of_the_neighbours(rng):
    points = cloud(rng)
    assert radius_of(points, LocalMotionSettings(reach_ratio=3.0)) == radius_of(points) / 2
    few = LocalMotionSettings(neighbours=80)
    assert np.isnan(carried(points[:2], points[:30], points[:30], radius=1.0, settings=few)).all()


def test_without_neighbours_the_motion_is_unknown(rng):
    points = cloud(rng)
    places = np.array([[3.0, 0.0, 0.0], [np.nan, 0.0, 0.0], [0.0, 0.0, 0.0]])
    moved = carried(places, points, points + 1.0, radius=0.04)
    assert np.isnan(moved[:2]).all()
    np.testing.assert_allclose(moved[2], 1.0, atol=1e-9)
    assert np.isnan(carried(places, np.zeros((0, 3)), np.zeros((0, 3)), radius=0.04)).all()
    assert neighbours_of(places[:0], points, radius=1.0).shape == (0, 8)
