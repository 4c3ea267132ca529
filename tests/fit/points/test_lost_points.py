import numpy as np
import pytest

from marey.fit.points.lost_points import LostPointSettings, expected_by_skin
from marey.geometry import rotations

X, Y = np.meshgrid(np.linspace(0, 0.2, 11), np.linspace(0, 0.2, 11))
REST = np.stack([X.ravel(), Y.ravel(), 0.02 * np.sin(20 * X.ravel())], axis=-1)
CORNER = (np.arange(10)[:, None] * 11 + np.arange(10)).ravel()
FACES = np.concatenate([
    np.stack([CORNER, CORNER + 1, CORNER + 11], axis=-1), np.stack([CORNER + 1, CORNER + 12, CORNER + 11], axis=-1)
])  # fmt: skip


def skin(frame: int):
    if frame == 7:
        return None
    return REST @ rotations.exp(np.array([0.1, 0.2, 0.3]) * frame).T + np.array([0.01, 0.02, 0.0]) * frame


@pytest.fixture
def points(rng) -> np.ndarray:
    weight = rng.dirichlet([2, 2, 2], 50)
    return np.einsum("nk,nki->ni", weight, REST[FACES[rng.integers(0, len(FACES), 50)]]) + [0.0, 0.0, 0.004]


def at(points, frame):
    return points @ rotations.exp(np.array([0.1, 0.2, 0.3]) * frame).T + np.array([0.01, 0.02, 0.0]) * frame


def test_points_move_with_the_skin(points):
    seen = np.arange(50) % 3
    last = np.stack([at(point, frame) for point, frame in zip(points, seen, strict=True)])
    places = expected_by_skin(skin, FACES)(5, last, seen)
    np.testing.assert_allclose(places, at(points, 5), atol=1e-12)


def test_points_stretch_with_the_skin(points):
    places = expected_by_skin(lambda frame: REST * [1 + 0.1 * frame, 1, 1], FACES)(1, points, np.zeros(50, int))
    np.testing.assert_allclose(places[:, 0], 1.1 * points[:, 0], atol=0.004 * 0.1)


def test_the_settings_limit_the_height_above_the_skin(points):
    expected = expected_by_skin(skin, FACES, LostPointSettings(most_above_m=1e-4))
    assert np.isnan(expected(3, points, np.zeros(50, int))).all()


def test_no_prediction_without_a_body_or_far_from_it(points):
    expected = expected_by_skin(skin, FACES)
    assert np.isnan(expected(7, points, np.zeros(50, int))).all()
    assert np.isnan(expected(3, points, np.full(50, 7))).all()
    assert np.isnan(expected(3, points + [0, 0, 0.1], np.zeros(50, int))).all()
    assert np.isnan(expected(3, points + [0.5, 0, 0], np.zeros(50, int))).all()
    assert expected(3, points[:0], np.zeros(0, int)).shape == (0, 3)
