import numpy as np
from tests.skin_clusters import thigh

from marey.markers.methods.point_cluster import redistributed


def moments(points, mass):
    centre = (mass[..., None] * points).sum(-2) / mass.sum(-1)[..., None]
    about = points - centre[..., None, :]
    return np.linalg.eigvalsh(np.einsum("...m,...mi,...mj->...ij", mass, about, about))


def test_the_masses_keep_the_eigenvalues(rng):
    shape = thigh(rng, 9)
    points = shape + rng.normal(0, 0.004, (25, 9, 3))
    wanted = np.broadcast_to(moments(shape, np.ones(9)), (25, 3))
    mass, kept = redistributed(points, np.ones((25, 9)), wanted)
    assert kept.all()
    np.testing.assert_allclose(moments(points, mass), wanted, rtol=1e-8)
    assert mass.min() > 0


def test_other_masses_that_keep_them_lie_hardly_nearer_to_unit_masses(rng):
    shape = thigh(rng, 9)
    points = shape + rng.normal(0, 0.004, (1, 9, 3))
    wanted = moments(shape, np.ones(9))[None]
    mass, _ = redistributed(points, np.ones((1, 9)), wanted)
    for _ in range(20):
        other, kept = redistributed(points, mass + rng.normal(0, 0.02, mass.shape), wanted)
        assert kept.all()
        assert np.linalg.norm(mass - 1) < 1.01 * np.linalg.norm(other - 1)


def test_a_rigid_cluster_keeps_its_unit_masses(rng):
    shape = thigh(rng, 6)
    mass, kept = redistributed(shape[None], np.ones((1, 6)), moments(shape, np.ones(6))[None])
    assert kept.all()
    np.testing.assert_allclose(mass, 1)


def test_a_cluster_that_flattens_beyond_what_masses_can_keep_keeps_unit_masses(rng):
    shape = thigh(rng, 7)
    flat = shape * [1, 1, 0]
    mass, kept = redistributed(flat[None], np.ones((1, 7)), moments(shape, np.ones(7))[None])
    assert not kept.any()
    np.testing.assert_array_equal(mass, 1)


def test_missing_markers_keep_no_mass(rng):
    shape = thigh(rng, 8)
    points = shape + rng.normal(0, 0.003, (4, 8, 3))
    points[:, 3] = np.nan
    start = np.ones((4, 8))
    start[:, 3] = 0
    wanted = np.broadcast_to(moments(shape[start[0] > 0], np.ones(7)), (4, 3))
    mass, kept = redistributed(points, start, wanted)
    assert kept.all()
    np.testing.assert_array_equal(mass[:, 3], 0)
