"""Lines that help the eye, and the overlay of recovered shapes."""

import numpy as np

from marey.view.pictures.shape_overlay import ShapeOverlay, ShapeScene, near_lines


def test_points_on_a_line_are_joined_one_after_the_other():
    shape = np.zeros((3, 5))
    shape[0] = [0, 3, 1, 2, np.nan]
    assert sorted(map(tuple, near_lines(shape).tolist())) == [(0, 2), (1, 3), (2, 3)]


def test_lines_hold_all_points_together(rng):
    lines = near_lines(rng.normal(size=(3, 40)))
    reached = {0}
    for _ in range(40):
        reached |= {b for pair in lines for b in pair if reached & set(pair.tolist())}
    assert reached == set(range(40))


def scene(points: np.ndarray, seen: np.ndarray) -> ShapeScene:
    """Points (3, P) in one frame; a second frame has no result."""
    placed = np.stack([points, np.full_like(points, np.nan)])
    measured = np.where(seen, placed[:, :2], np.nan)
    return ShapeScene(name="cam", measured=measured, modelled=placed[:, :2], placed=placed, lines=np.array([[0, 1]]))


def test_points_are_drawn_where_they_are_and_near_ones_are_brighter():
    points = np.array([[30.0, 80.0, 50.0], [60.0, 60.0, 90.0], [-10.0, 10.0, 0.0]])
    overlay = ShapeOverlay(scene(points, np.array([True, True, False])), (120, 100))
    drawn = overlay.draw(np.zeros((100, 120, 3), np.uint8), 0)
    assert drawn.shape == (100, overlay.size[0], 3)
    near, far, unseen = (drawn[int(y), int(x)].astype(int).sum() for x, y, _ in points.T)
    assert near > unseen > far > 0
    empty = overlay.draw(np.zeros((100, 120, 3), np.uint8), 1)
    assert not empty[40:, :120].any()


def test_large_images_are_halved():
    overlay = ShapeOverlay(scene(np.ones((3, 3)), np.ones(3, bool)), (1920, 1080))
    assert overlay.picture == (960, 540)
