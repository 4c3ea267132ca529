import numpy as np
import pytest

from marey.knee.outlines.outlines import edge_image, filled, on_the_edge


def circle(radius: float, centre: tuple[float, float], count: int = 200) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.array(centre) + radius * np.column_stack([np.cos(angle), np.sin(angle)])


@pytest.mark.parametrize("turn", [1, -1])
def test_the_pixels_within_an_outline_are_those_with_their_centres_inside(turn: int):
    row, column = np.mgrid[:40, :50]
    inside = np.hypot(column - 25.3, row - 18.1) < 11.2
    assert np.array_equal(filled(circle(11.2, (25.3, 18.1), 4000)[::turn], (40, 50)), inside)


def test_an_outline_on_the_edges_between_pixels_encloses_whole_ones():
    outline = np.array([[2, 3], [2, 6], [5, 6], [5, 3]]) - 0.5
    mask = filled(outline, (10, 10))
    assert np.array_equal(np.argwhere(mask).min(0), [3, 2])
    assert np.array_equal(np.argwhere(mask).max(0), [5, 4])
    assert mask.sum() == 9


def test_an_outline_may_reach_beyond_the_slice():
    mask = filled(circle(30.0, (0.0, 10.0)), (20, 15))
    assert mask.all()


def test_an_outline_of_pixels_is_moved_onto_a_blurred_edge():
    row, column = np.mgrid[:60, :60]
    radius = np.hypot(column - 30.2, row - 29.7)
    image = 1 / (1 + np.exp((radius - 17.4) / 0.7))
    mask = radius < 18.0
    corners = stairs_of(mask)
    found = np.hypot(*(on_the_edge(corners, edge_image(image)) - (30.2, 29.7)).T)
    before = np.hypot(*(corners - (30.2, 29.7)).T)
    assert np.abs(found - 17.4).mean() < 0.4 * np.abs(before - 17.4).mean()


def test_what_lies_on_the_border_stays_there():
    image = np.zeros((30, 30))
    image[:, 10:20] = 1.0
    top = np.column_stack([np.arange(20, 9, -1), np.zeros(11, int)])
    left = np.column_stack([np.full(30, 10), np.arange(1, 31)])
    bottom = np.column_stack([np.arange(11, 21), np.full(10, 30)])
    right = np.column_stack([np.full(29, 20), np.arange(29, 0, -1)])
    outline = np.concatenate([top, left, bottom, right]) - 0.5
    moved = on_the_edge(outline, edge_image(image))
    assert np.array_equal(moved[:11], outline[:11])
    assert filled(moved, (30, 30)).sum() == 300


def stairs_of(mask: np.ndarray) -> np.ndarray:
    """The edges of a convex mask's pixels, gone round by the angle about its middle."""
    row, column = np.nonzero(mask)
    corners = [np.column_stack([column + right, row + down]) for right in (0, 1) for down in (0, 1)]
    corners = np.unique(np.concatenate(corners), axis=0)
    padded = np.pad(mask, 1)
    some = [padded[y : y + 2, x : x + 2] for x, y in corners]
    corners = corners[[not each.all() for each in some]] - 0.5
    middle = corners.mean(0)
    return corners[np.argsort(np.arctan2(*(corners - middle).T))]
