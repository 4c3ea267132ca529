import numpy as np
import pytest

from marey.surface.points.bend import bends
from marey.surface.points.field import Field, Grid

GRID = Grid(left=20, top=30, spacing=2, rows=30, columns=40)
SECOND = np.array([[[0.004, 0.001], [0.001, -0.002]], [[-0.001, 0.0], [0.0, 0.003]]])
"""Second derivatives of x and of y in the search image [1/px]."""


def bent(grid=GRID, *, size=13, second=SECOND, found=None, noise=0.0):
    """Matches of a surface with constant second derivatives, each the best affine map over its patch."""
    x = grid.pixels - grid.pixels.mean(axis=0)
    maps = np.array([[0.9, 0.1], [0.0, 1.1]]) + np.einsum("kij,nj->nki", second, x)
    maps += noise * np.random.default_rng(3).normal(size=maps.shape)
    there = 100 + x @ [[0.9, 0.0], [0.1, 1.1]] + 0.5 * np.einsum("ni,kij,nj->nk", x, second, x)
    sizes = np.full(len(grid), size) if found is None else np.where(found, size, 0)
    there[sizes == 0], maps[sizes == 0] = np.nan, np.nan
    return Field(there=there, maps=maps, covariance=maps, correlation=np.ones(len(grid)), size=sizes)


@pytest.mark.parametrize("size", [13, 21, 49])
def test_the_bend_is_the_mean_of_the_second_derivatives_over_the_patch(size):
    half = size // 2
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    around = np.stack([x.ravel(), y.ravel()], axis=-1).astype(float)
    beyond = 0.5 * np.einsum("ni,kij,nj->nk", around, SECOND, around)
    affine = np.column_stack([np.ones(len(around)), around])
    middle = np.linalg.lstsq(affine, beyond, rcond=None)[0][0]
    np.testing.assert_allclose(bends(bent(size=size), GRID), np.broadcast_to(middle, (len(GRID), 2)), rtol=1e-4)


def test_neighbours_on_one_side_suffice():
    found = GRID.pixels[:, 0] < 50
    drawn = bends(bent(found=found), GRID)
    np.testing.assert_allclose(drawn[found], np.broadcast_to([0.014, 0.014], (found.sum(), 2)), rtol=1e-4)
    assert np.isnan(drawn[~found]).all()


def test_the_bend_is_unknown_in_directions_without_neighbours():
    alone = np.zeros(len(GRID), bool)
    alone[605] = True
    np.testing.assert_allclose(bends(bent(found=alone), GRID)[605], 0, atol=1e-12)
    row = np.arange(len(GRID)) // GRID.columns == 12
    np.testing.assert_allclose(bends(bent(found=row), GRID)[row][:, 0], 0.5 * 14 * 0.004, rtol=1e-3)


def test_noise_of_the_maps_hardly_looks_like_a_bend():
    drawn = bends(bent(second=0 * SECOND, noise=0.007), GRID).reshape(GRID.rows, GRID.columns, 2)[3:-3, 3:-3]
    # Slopes over 7 x 7 neighbours 2 px apart have 0.007 / sqrt(49 * 16) of noise; two of them enter, and M is 14.
    assert np.std(drawn) == pytest.approx(0.5 * 14 * np.sqrt(2) * 0.007 / np.sqrt(49 * 16), rel=0.2)
