import numpy as np

from marey.knee.space.minimal_cut import minimal_cut


def energy(evidence: np.ndarray, inside: np.ndarray, spacing: tuple[float, float, float], price: float) -> float:
    steps = [np.diff(inside, axis=axis, append=np.take(inside, [-1], axis)) / spacing[axis] for axis in range(3)]
    return float((-evidence * inside).sum() + price * np.sqrt(sum(each**2 for each in steps)).sum())


def ball(spacing: tuple[float, float, float], radius: float) -> np.ndarray:
    places = np.meshgrid(*[(np.arange(int(20 / s)) - 10 / s) * s for s in spacing], indexing="ij")
    return np.sqrt(sum(each**2 for each in places)) < radius


def test_noise_is_outvoted_and_thick_slices_do_not_matter(rng):
    for spacing in ((1.0, 1.0, 1.0), (2.0, 0.5, 0.5)):
        truth = ball(spacing, 7.0)
        evidence = np.where(truth, 1.0, -1.0) + rng.normal(0, 1.5, truth.shape)
        found = minimal_cut(evidence, evidence > 0, spacing, surface_nats_mm=1.0) > 0.5
        dice = 2 * (found & truth).sum() / (found.sum() + truth.sum())
        assert dice > 0.9


def test_the_result_does_not_depend_on_the_start_and_has_less_energy_than_others(rng):
    spacing, price = (1.0, 1.0, 1.0), 1.0
    truth = ball(spacing, 6.0)
    evidence = (np.where(truth, 1.0, -1.0) + rng.normal(0, 1.5, truth.shape)).astype(np.float32)
    first = minimal_cut(evidence, evidence > 0, spacing, surface_nats_mm=price)
    second = minimal_cut(evidence, np.ones(truth.shape, dtype=bool), spacing, surface_nats_mm=price)
    found = energy(evidence, first, spacing, price)
    np.testing.assert_allclose(found, energy(evidence, second, spacing, price), rtol=0.01)
    assert found < energy(evidence, truth.astype(float), spacing, price)
    assert found < energy(evidence, (evidence > 0).astype(float), spacing, price)


def test_settled_voxels_stay():
    evidence = np.full((8, 8, 8), -1.0)
    evidence[3:5, 3:5, 3:5] = 100.0
    found = minimal_cut(evidence, evidence > 0, (1.0, 1.0, 1.0), surface_nats_mm=3.0) > 0.5
    np.testing.assert_array_equal(found, evidence > 0)


def test_a_surface_lies_where_it_is_cheap():
    evidence = np.zeros((6, 20, 6))
    evidence[:, :3], evidence[:, -3:] = 100.0, -100.0
    for row in (6, 13):
        price = np.full(evidence.shape, 2.0)
        # The cost of a difference between two rows is assigned to the first one.
        price[:, row] = 0.5
        found = minimal_cut(evidence, evidence > 0, (1.0, 1.0, 1.0), surface_nats_mm=price, iterations=600) > 0.5
        assert found[:, : row + 1].all()
        assert not found[:, row + 1 :].any()
