import numpy as np
import pytest
from scipy.special import ndtr

from marey.knee.cartilage.evidence import DEPTHS_MM, FIRST_MM, LEVELS_MM, STEP_MM, STRAY
from marey.knee.cartilage.joint_space import EDGE_SLOPES, WIDEST_BLURS, joint_space_costs

LOW, WIDE, SPREAD, SHARE = -0.5, 0.04, 0.06, 0.4
MIDDLES = LOW + WIDE * (np.arange(100) + 0.5)
OVER_COSTS = 0.5 * ((MIDDLES - 0.3) / 0.15) ** 2
MARROW, BEGINS, BEGINS_SD, ENDS = 0.2, 3.1, 0.6, 5.05


def costs(values: np.ndarray, theirs: np.ndarray, blur: float) -> np.ndarray:
    every = np.ones(len(values))
    return joint_space_costs(
        values, theirs, OVER_COSTS, MARROW * every, blur * every, SHARE * every, BEGINS * every, BEGINS_SD * every,
        ENDS * every, SPREAD, LEVELS_MM, DEPTHS_MM, (FIRST_MM, STRAY, LOW, WIDE),
    )  # fmt: skip


def plain_cost(values: np.ndarray, theirs: np.ndarray, blur: float, thick: float, wide: float) -> float:
    """Return the cost of one profile for one thickness and one width of the gap."""
    used = (DEPTHS_MM >= FIRST_MM - 1e-9) & (DEPTHS_MM <= ENDS)
    usual, begin = np.log(SPREAD * np.sqrt(2 * np.pi)), thick + wide
    inner = MARROW + (1 - MARROW) * ndtr(DEPTHS_MM / blur)
    variance = SPREAD**2 + (EDGE_SLOPES[0] * (1 - MARROW) * np.exp(-0.5 * (DEPTHS_MM / blur) ** 2)) ** 2
    reach = np.ceil(2 * blur / STEP_MM) * STEP_MM + 1e-6
    near = used & (thick - reach <= DEPTHS_MM) & (begin + reach >= DEPTHS_MM)
    gap = ndtr((DEPTHS_MM - thick) / blur) - ndtr((DEPTHS_MM - begin) / blur)
    times = max(SHARE * wide / STEP_MM, 1.0)
    misfit = values - inner - np.outer(MIDDLES[::2] - 1, gap)
    level = np.argmin(SHARE * 0.5 * (misfit**2 / variance)[:, near].sum(1) + times * OVER_COSTS[::2])
    contrast = MIDDLES[::2][level] - 1
    slopes = sum(np.exp(-(((DEPTHS_MM - at) / blur) ** 2)) for at in (thick, begin))
    spread = np.where(near, variance + (EDGE_SLOPES[1] * contrast) ** 2 * slopes, variance)
    off = (values - inner - np.where(near, contrast * gap, 0)) ** 2 / spread
    each = usual - np.log((1 - STRAY) * np.exp(-0.5 * off) + STRAY)
    each = np.where(begin + reach < DEPTHS_MM, theirs, each)
    there = 0.5 * ((begin - BEGINS) / BEGINS_SD) ** 2
    return float(SHARE * each[used].sum() + times * (OVER_COSTS[::2][level] - usual) + there)


@pytest.mark.parametrize("thick", [0.0, 0.8, 2.2, 4.0])
def test_the_costs_are_those_of_the_plain_formula_at_the_likeliest_width(thick, rng):
    blur = 0.43
    values = np.clip(0.8 + 0.3 * rng.normal(size=(3, len(DEPTHS_MM))), LOW, 3.4)
    theirs = rng.uniform(0, 2, values.shape)
    found = costs(values, theirs, blur)[:, np.argmin(abs(LEVELS_MM - thick))]
    widths = STEP_MM * np.arange(1, int(WIDEST_BLURS * blur / STEP_MM + 0.5) + 1)
    widths = widths[thick + widths <= ENDS + STEP_MM]
    for v in range(3):
        plain = min(plain_cost(values[v], theirs[v], blur, thick, wide) for wide in widths)
        np.testing.assert_allclose(found[v], plain, rtol=1e-9)


def test_a_thickness_that_leaves_no_gap_before_the_end_of_the_profile_is_impossible():
    values = np.ones((1, len(DEPTHS_MM)))
    found = costs(values, values, 0.4)[0]
    assert np.isfinite(found[LEVELS_MM < ENDS - STEP_MM]).all()
    assert np.isinf(found[LEVELS_MM > ENDS + STEP_MM]).all()
