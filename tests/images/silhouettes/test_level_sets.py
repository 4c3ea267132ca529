from itertools import pairwise

import numpy as np
import pytest
from tests.reference_level_sets import votes

from marey.images.silhouettes.level_sets import evolve, evolve_coarse_to_fine, region_energy


def disc(shape=(60, 80), centre=(30, 40), radius=15):
    y, x = np.indices(shape)
    return (y - centre[0]) ** 2 + (x - centre[1]) ** 2 <= radius**2


def evidence_of(mask, size=3.0):
    return np.where(mask, size, -size).astype(np.float32)


def test_a_disc_is_found_from_a_shifted_start():
    start = disc(centre=(34, 45), radius=9)
    found = evolve(evidence_of(disc()), start, length=1.0)
    assert np.array_equal(found, disc())


def test_without_length_each_pixel_reached_follows_its_evidence(rng):
    evidence = rng.normal(size=(40, 50)).astype(np.float32)
    found = evolve(evidence, evidence > 0, length=0.0)
    assert np.array_equal(found, evidence > 0)


def test_a_stray_pixel_goes_and_a_gap_closes():
    evidence = evidence_of(disc())
    evidence[5, 5] = 3.0
    evidence[30, 40] = -3.0
    found = evolve(evidence, evidence > 0, length=4.0)
    assert not found[5, 5]
    assert found[30, 40]


def test_nothing_comes_from_an_empty_start():
    assert not evolve(evidence_of(disc()), np.zeros((60, 80), bool), length=1.0).any()


def test_coarse_images_lead_to_a_better_minimum_than_a_start_far_away(rng):
    evidence = (evidence_of(disc(), 2.0) + rng.normal(0, 3, (60, 80))).astype(np.float32)
    start, energies = disc(centre=(30, 56)), []
    for found in (
        evolve(evidence, start, length=4.0),
        evolve_coarse_to_fine(evidence, start, length=4.0, halvings=2),
        evolve_coarse_to_fine(evidence, None, length=4.0, halvings=2),
    ):
        energies.append(region_energy(evidence, found, length=4.0))
    nearest, *coarse = energies
    assert max(coarse) < nearest
    # Both starts lead to the same region but for a few pixels of its border.
    assert (found ^ disc()).sum() < 0.05 * disc().sum()


def test_without_halvings_only_strong_evidence_overrides_the_start():
    evidence, start = evidence_of(disc()), disc(centre=(34, 45), radius=9)
    same = evolve_coarse_to_fine(evidence, start, length=100.0, halvings=0)
    assert np.array_equal(same, evolve(evidence, start, length=100.0))


@pytest.mark.parametrize("length", [0.5, 2.0, 6.0])
def test_no_pixel_of_the_border_would_still_change_sides(rng, length):
    evidence = (evidence_of(disc()) + rng.normal(0, 4, (60, 80))).astype(np.float32)
    found = evolve(evidence, disc(radius=20), length=length)
    wanted = votes(evidence, found, length=length)
    border = np.zeros_like(found)
    for axis in (0, 1):
        for step in (-1, 1):
            beside = np.roll(found, step, axis) != found
            edge = 0 if step == 1 else -1
            beside[(edge, slice(None)) if axis == 0 else (slice(None), edge)] = False
            border |= beside
    assert (wanted[border & found] >= -1e-4).all()
    assert (wanted[border & ~found] <= 1e-4).all()


def test_the_energy_never_rises(rng):
    evidence = (evidence_of(disc(), 1.0) + rng.normal(0, 3, (60, 80))).astype(np.float32)

    start = disc(radius=20)
    found = [evolve(evidence, start, length=2.0, sweeps=n) for n in range(8)]
    energies = [region_energy(evidence, region, length=2.0) for region in found]
    assert all(later <= earlier + 1e-3 for earlier, later in pairwise(energies))
    assert energies[-1] < energies[0]


def test_a_region_at_the_border_of_the_image_stays_there():
    mask = np.zeros((40, 40), bool)
    mask[:20, 10:30] = True
    found = evolve(evidence_of(mask), mask, length=2.0)
    assert found[0, 12:28].all()


def test_the_energy_changes_by_the_vote_of_a_pixel_that_changes_sides(rng):
    evidence = rng.normal(0, 3, (30, 40)).astype(np.float32)
    region = rng.random((30, 40)) > 0.5
    wanted = votes(evidence, region, length=2.5)
    before = region_energy(evidence, region, length=2.5)
    for y, x in ((10, 10), (15, 30), (20, 7), (12, 22)):
        other = region.copy()
        other[y, x] = not region[y, x]
        change = region_energy(evidence, other, length=2.5) - before
        assert change == pytest.approx(wanted[y, x] if region[y, x] else -wanted[y, x], abs=1e-3)


def test_an_empty_region_has_no_energy(rng):
    evidence = rng.normal(0, 3, (30, 40)).astype(np.float32)
    assert region_energy(evidence, np.zeros((30, 40), bool), length=2.0) == 0
    assert region_energy(evidence, evidence > 0, length=0.0) == pytest.approx(-evidence[evidence > 0].sum(), rel=1e-5)
