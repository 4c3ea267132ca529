"""Outlines of shapes whose outline is known."""

import numpy as np
import pytest

from marey.images.silhouettes.contours import trace_contour


def disc(radius: float, centre=(50.0, 40.0), shape=(90, 110)):
    y, x = np.mgrid[: shape[0], : shape[1]]
    return np.hypot(x - centre[0], y - centre[1]) <= radius


def test_a_discs_outline_lies_on_its_circle_and_looks_to_its_centre():
    contour = trace_contour(disc(25.0))
    out = contour.pixels - [50.0, 40.0]
    radius = np.linalg.norm(out, axis=1)
    # A ring pixel has a neighbour outside: it lies within one pixel of the circle, on the inner side.
    assert radius.min() > 24.0
    assert radius.max() <= 25.0
    np.testing.assert_allclose(np.linalg.norm(contour.inward, axis=1), 1.0, atol=1e-6)
    # Steps of a pixel, seen through a blur of 1.5: the error of the direction is at most about 0.1 rad.
    assert np.einsum("na,na->n", contour.inward, -out / radius[:, None]).min() > np.cos(0.15)


def test_every_outline_pixel_is_inside_and_has_a_neighbour_outside(rng):
    mask = np.zeros((60, 70), bool)
    for _ in range(4):
        mask |= disc(rng.uniform(5, 12), centre=rng.uniform(20, 45, 2), shape=(60, 70))
    x, y = trace_contour(mask).pixels.astype(int).T
    assert mask[y, x].all()
    assert (~(mask[y - 1, x] & mask[y + 1, x] & mask[y, x - 1] & mask[y, x + 1])).all()


def test_a_hole_has_an_outline_that_looks_away_from_it():
    contour = trace_contour(disc(30.0) & ~disc(8.0))
    out = contour.pixels - [50.0, 40.0]
    radius = np.linalg.norm(out, axis=1)
    inner = radius < 15
    assert inner.sum() > 30
    assert (np.einsum("na,na->n", contour.inward, out)[inner] > 0).all()


def test_the_images_border_is_no_outline():
    mask = np.zeros((40, 50), bool)
    mask[:, 10:30] = True
    contour = trace_contour(mask, border=2)
    assert set(contour.pixels[:, 0]) == {10.0, 29.0}
    assert contour.pixels[:, 1].min() == 2
    assert contour.pixels[:, 1].max() == 37
    # The border of the image is no outline: normals there are perpendicular to the border.
    np.testing.assert_allclose(np.abs(contour.inward[:, 0]), 1.0, atol=1e-6)


@pytest.mark.parametrize("mask", [np.zeros((20, 30), bool), np.ones((20, 30), bool)], ids=["empty", "full"])
def test_where_nothing_ends_there_is_no_outline(mask):
    contour = trace_contour(mask)
    assert contour.pixels.shape == contour.inward.shape == (0, 2)


def test_a_line_of_one_pixel_has_no_side_and_is_left_out():
    mask = np.zeros((30, 60), bool)
    mask[15, 10:50] = True
    column = trace_contour(mask).pixels[:, 0]
    # The smoothing reaches seven pixels: farther inside, nothing is left of the line's ends.
    assert not ((column > 17) & (column < 42)).any()


def test_beside_what_hides_the_person_there_is_no_outline():
    mask, box = disc(25.0), np.zeros((90, 110), bool)
    box[:, 60:] = True
    free = trace_contour(mask & ~box)
    contour = trace_contour(mask & ~box, hidden=box)
    assert free.pixels[:, 0].max() == 59
    # The box's border lies at 59.5; pixels within two of it are left out, and all others are kept.
    assert contour.pixels[:, 0].max() == 57
    kept = free.pixels[free.pixels[:, 0] <= 57]
    np.testing.assert_array_equal(contour.pixels, kept)
    np.testing.assert_array_equal(contour.inward, free.inward[free.pixels[:, 0] <= 57])


def test_nothing_hidden_changes_no_outline_and_everything_hidden_leaves_none():
    mask = disc(25.0)
    np.testing.assert_array_equal(trace_contour(mask, hidden=np.zeros_like(mask)).pixels, trace_contour(mask).pixels)
    assert len(trace_contour(mask, hidden=np.ones_like(mask)).pixels) == 0
