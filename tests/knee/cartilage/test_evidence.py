import numpy as np
import pytest
from scipy.special import ndtr

from marey.knee.cartilage.evidence import (
    DEPTHS_MM,
    FIRST_MM,
    LEVELS_MM,
    OVER_MM,
    STEP_MM,
    STRAY,
    Profiles,
    Tissues,
    layer_costs,
    measured_blur,
    read_profiles,
)
from marey.knee.space.volume import Volume, VoxelGrid

MARROW, OVER, SPREAD = 0.12, 0.25, 0.05
BINS = np.arange(-0.5, 3.5001, 0.04)
FREE = np.array([np.inf])


def profile(thick: float, blur: float, *, over: float = OVER) -> np.ndarray:
    inner, outer = ndtr(DEPTHS_MM / blur), ndtr((DEPTHS_MM - thick) / blur)
    return MARROW + (1 - MARROW) * inner + (over - 1) * outer


def seen_in(values: np.ndarray) -> Tissues:
    middles = 0.5 * (BINS[1:] + BINS[:-1])
    over = 0.97 * np.exp(-0.5 * ((middles - OVER) / 0.1) ** 2) / (0.1 * np.sqrt(2 * np.pi)) + 0.03 / 4
    return Tissues(relative=values, marrow=np.full(len(values), MARROW), spread=SPREAD, over=over)


def profiles_of(values: np.ndarray, blur: float) -> Profiles:
    every = np.ones(len(values))
    return Profiles(values=values, blur_mm=blur * every, correlation_mm=0.5 * every)


def costs_of(values: np.ndarray, blur: float, *, begins: float = np.inf, sd: float = 0.5, ends: float = np.inf):
    every = np.ones(len(values))
    costs = layer_costs(profiles_of(values, blur), seen_in(values), begins * every, sd * every, ends * every)
    return np.minimum(costs.apart, costs.touching)


@pytest.mark.parametrize("thick", [0.8, 1.2, 2.0, 4.4])
def test_a_layer_thinner_than_the_blur_of_its_edges_is_measured(thick, rng):
    blur = 0.5
    values = profile(thick, blur) + rng.normal(0, SPREAD, (200, len(DEPTHS_MM)))
    found = LEVELS_MM[costs_of(values, blur).argmin(1)]
    # The levels lie 0.2 mm apart, so that a single result has an error of up to 0.1 mm.
    assert abs(found.mean() - thick) < 0.1
    assert found.std() < 0.25


def test_a_bare_bone_is_distinguished_from_a_thin_layer(rng):
    noise = rng.normal(0, SPREAD, (200, len(DEPTHS_MM)))
    assert (costs_of(profile(0.0, 0.4) + noise, 0.4).argmin(1) == 0).mean() > 0.95
    assert (costs_of(profile(1.0, 0.4) + noise, 0.4).argmin(1) > 0).all()


def test_the_costs_without_another_bone_are_those_of_the_plain_formula(rng):
    blur = 0.45
    values = np.clip(profile(2.1, blur) + rng.normal(0, SPREAD, (3, len(DEPTHS_MM))), -0.5, 3.4999)
    seen = seen_in(values)
    bins = ((values + 0.5) / 0.04).astype(int)
    for v, n in [(0, 0), (1, 5), (2, 12), (2, 30)]:
        thick = LEVELS_MM[n]
        first = int((thick + 1.5 * blur - DEPTHS_MM[0]) / STEP_MM + 0.5)
        over = values[v, first : first + int(OVER_MM / STEP_MM + 0.5) + 1].mean()
        model = profile(thick, blur, over=over)
        variance = SPREAD**2 + (0.3 * (1 - MARROW) * np.exp(-0.5 * (DEPTHS_MM / blur) ** 2)) ** 2
        variance += (0.15 * (over - 1) * np.exp(-0.5 * ((DEPTHS_MM - thick) / blur) ** 2)) ** 2
        misfit = -np.log((1 - STRAY) * np.exp(-0.5 * (values[v] - model) ** 2 / variance) + STRAY)
        paid = -np.log(seen.over[int((over + 0.5) / 0.04)])
        within = misfit + np.where(thick >= DEPTHS_MM, np.log(SPREAD * np.sqrt(2 * np.pi)), paid)
        beyond = -np.log(seen.over[bins[v]])
        each = np.where(thick + 2 * blur < DEPTHS_MM, beyond, within)[DEPTHS_MM >= FIRST_MM]
        np.testing.assert_allclose(costs_of(values, blur)[v, n], each.sum() * STEP_MM / 0.5, rtol=1e-9)


def test_where_cartilages_touch_the_prediction_decides_and_where_a_gap_is_visible_the_gap():
    blur, away = 0.3, 5.0
    touching = np.minimum(profile(9.0, blur), 1.0)[None]
    found = LEVELS_MM[costs_of(touching, blur, begins=2.6, sd=0.5, ends=away).argmin(1)]
    assert abs(found[0] - 2.6) < 0.21
    gap = profile(3.4, blur)[None] + (1 - OVER) * ndtr((DEPTHS_MM - 4.4) / blur)
    found = LEVELS_MM[costs_of(gap, blur, begins=2.6, sd=0.8, ends=away).argmin(1)]
    assert abs(found[0] - 3.4) < 0.21


def test_the_edge_of_a_gap_narrower_than_the_blur_is_measured_although_the_prediction_is_wrong(rng):
    blur, thick = 0.45, 2.4
    for wide in (0.6, 1.0, 1.6):
        dip = (1 - OVER) * (ndtr((DEPTHS_MM - thick) / blur) - ndtr((DEPTHS_MM - thick - wide) / blur))
        values = profile(9.0, blur) * (DEPTHS_MM < 2) + (DEPTHS_MM >= 2) - dip
        values = values + rng.normal(0, SPREAD, (100, len(DEPTHS_MM)))
        found = LEVELS_MM[costs_of(values, blur, begins=thick + wide + 0.8, sd=0.8, ends=6.0).argmin(1)]
        # The width and the contrast of a gap are known by their product alone: half of the wrong width is left.
        assert abs(found.mean() - thick) < 0.15
        assert found.std() < 0.25


def test_the_blur_is_measured_at_the_edges(rng):
    true = 0.6
    thick = rng.uniform(3.0, 5.0, 300)
    values = np.stack([profile(each, true) for each in thick]) + rng.normal(0, SPREAD, (300, len(DEPTHS_MM)))
    guessed = profiles_of(values, 0.4)
    blur = 0.4
    for _ in range(3):  # As often as the sheet is computed again.
        blur *= measured_blur(profiles_of(values, blur), seen_in(values), thick, np.ones(300, bool))
    assert abs(blur - true) < 0.05
    assert measured_blur(guessed, seen_in(values), thick, thick < 3.01) == 1.0


def test_an_edge_is_more_blurred_across_thick_slices():
    matrix = np.diag([0.4, 0.4, 2.0, 1.0])
    volume = Volume(intensity=np.zeros((10, 40, 40)), grid=VoxelGrid(shape=(10, 40, 40), lps_from_voxel=matrix))
    read = read_profiles(volume, np.full((2, 3), 8.0), np.array([[1.0, 0, 0], [0, 0, 1.0]]))
    assert read.values.shape == (2, len(DEPTHS_MM))
    np.testing.assert_allclose(read.blur_mm**2, np.array([0.4, 2.0]) ** 2 / 4 + 0.3**2)
