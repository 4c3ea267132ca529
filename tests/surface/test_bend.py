import numpy as np
import pytest

from marey.surface.bend import unbent
from marey.surface.field import Field, Grid

GRID = Grid(left=10, top=12, spacing=2, rows=30, columns=40)
BENT = np.array([[[0.004, 0.001], [0.001, -0.002]], [[0.001, 0.0], [0.0, 0.003]]])
"""Second derivatives of where the search picture shows a pixel (x, y of it, by two directions) [1/px]."""


def bent_field(size, *, found=None):
    """What affine maps make of a quadratic displacement: the least squares over each patch, computed outright."""
    half = size // 2
    y, x = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1).astype(float)
    around = np.stack([x, y], axis=-1)
    centre = GRID.pixels.mean(axis=0)
    place = lambda p: p + 0.5 * np.einsum("...i,kij,...j->...k", p - centre, BENT, p - centre)  # noqa: E731
    design = np.column_stack([np.ones(len(around)), around])
    seen = place(GRID.pixels[:, None] + around)
    fit = np.linalg.lstsq(design, seen.swapaxes(0, 1).reshape(len(around), -1), rcond=None)[0].reshape(3, len(GRID), 2)
    maps = fit[1:].transpose(1, 2, 0)
    count = len(GRID)
    whole = Field(
        there=fit[0], maps=maps, covariance=np.tile(1e-3 * np.eye(2), (count, 1, 1)), correlation=np.full(count, 0.9),
        size=np.full(count, size),
    )  # fmt: skip
    return whole if found is None else whole.only(found), place(GRID.pixels)


@pytest.mark.parametrize("size", [5, 9])
def test_a_bend_is_taken_back_where_maps_on_both_sides_are_known(size):
    field, truth = bent_field(size)
    before = np.linalg.norm(field.there - truth, axis=1)
    after = np.linalg.norm(unbent(field, GRID).there - truth, axis=1).reshape(GRID.rows, GRID.columns)
    assert before.min() > 0.004
    assert after[1:-1, 1:-1].max() < 1e-9


def test_a_step_in_depth_is_no_bend():
    field, _ = bent_field(13)
    there, maps = np.array(field.there), np.array(field.maps)
    right = GRID.pixels[:, 0] > 50
    maps[right] += [[0.5, 0], [0, 0]]
    stepped = Field(there=there, maps=maps, covariance=field.covariance, correlation=field.correlation, size=field.size)
    moved = np.linalg.norm(unbent(stepped, GRID).there - there, axis=1)
    assert moved.max() <= 0.3


def test_lonely_matches_stay_as_they_are():
    found = np.zeros(len(GRID), bool)
    found[[100, 500]] = True
    field, _ = bent_field(13, found=found)
    np.testing.assert_array_equal(unbent(field, GRID).there, field.there)
