import numpy as np
import pytest

from marey.errors import MareyError
from marey.knee.outlines.boundary_elements import learned_costs
from marey.knee.outlines.live_wire import LiveWire
from marey.knee.outlines.outlines import filled

CENTRE = (34.0, 28.0)
RADIUS = 17.3
ANCHORS = [(34, 10.7), (17, 28), (34, 45.3), (51.3, 28)]


def made_slice(rng: np.random.Generator, spacing: tuple[float, float] = (1.0, 1.0)) -> np.ndarray:
    """A dark disc in a brighter ring in a dark field, in noise; the wire must follow the inner edge of the ring."""
    row, column = np.mgrid[:60, :70]
    radius = np.hypot(column - CENTRE[0], row - CENTRE[1])
    image = np.where(radius < RADIUS, 20.0, np.where(radius < RADIUS + 7, 100.0, 30.0))
    return image + rng.normal(0, 5.0, image.shape)


def disc() -> np.ndarray:
    row, column = np.mgrid[:60, :70]
    return np.hypot(column - CENTRE[0], row - CENTRE[1]) < RADIUS


def dice(first: np.ndarray, second: np.ndarray) -> float:
    return float(2 * (first & second).sum() / (first.sum() + second.sum()))


@pytest.mark.parametrize("turn", [1, -1])
def test_an_outline_through_four_anchors_finds_the_disc_whichever_way_they_are_given(
    rng: np.random.Generator, turn: int
):
    wire = LiveWire(made_slice(rng), (1.0, 1.0))
    closed = wire.closed(ANCHORS[::turn])
    assert dice(closed.mask(wire.shape), disc()) > 0.97
    x, y = closed.outline.T
    assert np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) < 0  # anticlockwise, because y points down


def test_the_wire_goes_from_the_anchor_to_the_pointer_along_the_edge(rng: np.random.Generator):
    wire = LiveWire(made_slice(rng), (1.0, 1.0))
    start = wire.anchor(ANCHORS[0])
    path = wire.path_to(ANCHORS[2])
    assert np.array_equal(path[0], start)
    assert np.abs(path[-1] - ANCHORS[2]).max() <= 0.5
    assert np.abs(np.hypot(*(path - CENTRE).T) - RADIUS).mean() < 1.0
    assert (np.abs(np.diff(path, axis=0)).sum(axis=1) == 1).all()


def test_a_learned_wire_keeps_to_the_edge_it_was_shown(rng: np.random.Generator):
    wire = LiveWire(made_slice(rng), (1.0, 1.0))
    closed = wire.closed(ANCHORS)
    learned = learned_costs([(wire.elements, closed.mask(wire.shape))])
    other = LiveWire(made_slice(rng), (1.0, 1.0), learned)
    # Two anchors, one of them a pixel and a half on the wrong side, in the bright ring.
    found = other.closed([(34, 9.2), (34, 45.3)])
    assert dice(found.mask(other.shape), disc()) > 0.96


def test_moving_an_anchor_changes_its_two_sides_only(rng: np.random.Generator):
    wire = LiveWire(made_slice(rng), (1.0, 1.0))
    closed = wire.closed(ANCHORS)
    for index in range(4):
        place = closed.anchors[index][::-1] + (2.0, -3.0)
        moved = wire.moved(closed, index, place)
        kept = [moved.sides[side] is closed.sides[side] for side in range(4)]
        assert sorted(np.flatnonzero(~np.array(kept)).tolist()) == sorted({index, (index - 1) % 4})
        afresh = [wire.cost(tuple(side[0]), tuple(side[-1])) for side in moved.sides]
        assert afresh == [wire.cost(tuple(side[0]), tuple(side[-1]), keep_end=True) for side in moved.sides]
        ends = [tuple(side[0]) for side in moved.sides]
        assert ends == [tuple(anchor) for anchor in moved.anchors]


def test_a_bone_cut_off_by_the_slices_border_is_closed_along_it(rng: np.random.Generator):
    image = np.full((60, 60), 90.0)
    image[:40, 20:42] = 20.0
    wire = LiveWire(image + rng.normal(0, 4, image.shape), (1.0, 1.0))
    closed = wire.closed([(20, 0), (30, 39.5), (41, 0)])
    expected = np.zeros((60, 60), bool)
    expected[:40, 20:42] = True
    assert dice(closed.mask(wire.shape), expected) > 0.97


def test_pixels_that_are_not_square_change_the_shortest_way():
    flat = np.zeros((40, 40))
    wide, square = LiveWire(flat, (1.0, 2.0)), LiveWire(flat, (1.0, 1.0))
    along, down = ((20, 15), (20, 25)), ((15, 20), (25, 20))
    assert square.cost(*along) == square.cost(*down) == wide.cost(*along)
    assert wide.cost(*down) == pytest.approx(wide.cost(*along) / 2, rel=0.001)


def test_what_is_no_slice_and_no_outline_is_an_error(rng: np.random.Generator):
    with pytest.raises(MareyError, match="too small"):
        LiveWire(np.zeros((2, 50)), (1.0, 1.0))
    with pytest.raises(MareyError, match="finite"):
        LiveWire(np.full((20, 20), np.nan), (1.0, 1.0))
    wire = LiveWire(made_slice(rng), (1.0, 1.0))
    with pytest.raises(MareyError, match="needs an anchor first"):
        wire.path_to((3, 4))
    with pytest.raises(MareyError, match="two anchors"):
        wire.closed([(3, 4), (3.1, 4.1)])


def test_points_beyond_the_slice_become_corners_of_its_border(rng: np.random.Generator):
    wire = LiveWire(made_slice(rng), (1.0, 1.0))
    assert wire.corner((-9, 100)) == (60, 0)
    assert filled(wire.closed([(-5, -5), (90, 90), (90, -5), (-5, 90)]).outline, (60, 70)).any()
