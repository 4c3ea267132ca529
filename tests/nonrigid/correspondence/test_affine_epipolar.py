import numpy as np
from tests.nonrigid.filmed_surfaces import CAMERAS, filmed, moving_surface

from marey.geometry import rotations
from marey.nonrigid.correspondence.affine_epipolar import epipolar_hypotheses, fitted_equation, square_distances


def centred(tracks):
    return tracks - tracks.mean(2, keepdims=True)


def true_equation(scale):
    """Derive a, b, c, d from the cameras' rows: what annuls both."""
    first, second = (rotations.exp(np.asarray(camera, float))[:2] for camera in CAMERAS[:2])
    return np.linalg.svd(np.concatenate([first, scale * second]).T)[2][-1]


def test_the_equation_follows_from_pairs_whatever_the_surface_does():
    surface = moving_surface(np.random.default_rng(0))
    views = [centred(filmed(surface, camera, scale=s)) for camera, s in zip(CAMERAS, (1.0, 0.7), strict=False)]
    found = fitted_equation(*views)
    np.testing.assert_allclose(
        found * np.sign(found[0]), true_equation(0.7) * np.sign(true_equation(0.7)[0]), atol=1e-9
    )


def test_the_equation_is_found_without_pairs():
    surface, random = moving_surface(np.random.default_rng(0), points=20), np.random.default_rng(2)
    order = random.permutation(20)
    views = [filmed(surface, CAMERAS[0]), filmed(surface[:, order], CAMERAS[1])]
    best = epipolar_hypotheses(*(centred(view)[::4] for view in views), count=10)[0]
    assert np.array_equal(best.rows, order[best.columns])
    assert len(best.rows) >= 15
    assert abs(best.equation @ true_equation(1.0)) > 1 - 1e-9


def test_square_distances_are_those_of_columns():
    random = np.random.default_rng(0)
    left, right = random.normal(size=(5, 3)), random.normal(size=(5, 4))
    np.testing.assert_allclose(square_distances(left, right)[1, 2], np.sum((left[:, 1] - right[:, 2]) ** 2))
