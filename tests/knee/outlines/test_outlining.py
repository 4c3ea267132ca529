from dataclasses import replace

import numpy as np
import pytest

from marey.errors import MareyError
from marey.knee.outlines.contours import Contour
from marey.knee.outlines.live_wire import LiveWire
from marey.knee.outlines.outlines import filled
from marey.knee.outlines.outlining import anchor_inserted, anchor_moved, anchor_places, anchor_removed, drawn

CENTRE, RADIUS = (40.3, 36.8), 21.4
ANCHORS = [(CENTRE[0] + RADIUS * np.cos(angle), CENTRE[1] + RADIUS * np.sin(angle)) for angle in (0.2, 1.9, 3.1, 4.9)]


@pytest.fixture
def wire(rng: np.random.Generator) -> LiveWire:
    row, column = np.mgrid[:76, :84]
    edge = np.hypot(column - CENTRE[0], row - CENTRE[1]) - RADIUS
    return LiveWire(100 / (1 + np.exp(-edge / 0.7)) + rng.normal(0, 3, edge.shape), (0.5, 0.5))


@pytest.fixture
def contour(wire: LiveWire) -> Contour:
    return drawn(wire, ANCHORS, structure="femur", axis="k", index=3)


def off_circle(contour: Contour) -> np.ndarray:
    return np.abs(np.hypot(*(contour.outline - CENTRE).T) - RADIUS)


def test_a_drawn_outline_lies_on_the_edge_to_a_part_of_a_pixel(contour: Contour, wire: LiveWire):
    pixels = np.abs(np.hypot(*(wire.closed(ANCHORS).outline - CENTRE).T) - RADIUS)
    assert off_circle(contour).mean() < 0.25
    assert off_circle(contour).mean() < 0.6 * pixels.mean()


def test_moving_an_anchor_leaves_the_outline_beyond_its_neighbours_as_it_is(contour: Contour, wire: LiveWire):
    place = np.array(CENTRE) + 0.6 * (contour.anchors[1] - CENTRE)
    moved = anchor_moved(contour, wire, 1, place)
    assert np.abs(moved.anchors[1] - place).max() <= 0.5
    assert np.array_equal(np.delete(moved.anchors, 1, 0), np.delete(contour.anchors, 1, 0))
    kept = {tuple(point) for point in moved.outline} & {tuple(point) for point in contour.outline}
    places = anchor_places(contour)
    beyond = (places[0] - places[2]) % len(contour.outline) - 1
    assert len(kept) >= beyond
    back = anchor_moved(moved, wire, 1, contour.anchors[1])
    assert off_circle(back).mean() < 0.3


def test_every_anchor_can_be_moved_and_back(contour: Contour, wire: LiveWire):
    size = (76, 84)
    whole = filled(contour.outline, size)
    for number in range(4):
        moved = anchor_moved(contour, wire, number, contour.anchors[number] + (1.0, -1.0))
        back = filled(anchor_moved(moved, wire, number, contour.anchors[number]).outline, size)
        assert (back ^ whole).sum() < 0.02 * whole.sum()


def test_an_anchor_set_on_an_outline_changes_nothing_but_the_list_of_anchors(contour: Contour, wire: LiveWire):
    places = anchor_places(contour)
    for number in range(4):
        middle = places[number] + ((places[(number + 1) % 4] - places[number]) % len(contour.outline)) // 2
        point = contour.outline[middle % len(contour.outline)]
        more, found = anchor_inserted(contour, wire, point)
        assert found == number + 1
        assert np.abs(more.anchors[found] - point).max() <= 0.5
        assert np.array_equal(np.delete(more.anchors, found, 0), contour.anchors)
        assert np.array_equal(more.outline, contour.outline)


def test_an_anchor_taken_away_lets_the_wire_run_without_it(contour: Contour, wire: LiveWire):
    astray = anchor_moved(contour, wire, 2, np.array(CENTRE))
    assert off_circle(astray).mean() > 1
    fewer = anchor_removed(astray, wire, 2)
    assert len(fewer.anchors) == 3
    assert off_circle(fewer).mean() < 0.3
    least = anchor_removed(fewer, wire, 0)
    with pytest.raises(MareyError, match="two anchors"):
        anchor_removed(least, wire, 0)


def test_an_outline_of_two_anchors_can_be_changed(contour: Contour, wire: LiveWire):
    two = drawn(wire, [ANCHORS[0], ANCHORS[2]], structure="femur", axis="k", index=3)
    moved = anchor_moved(two, wire, 0, ANCHORS[1])
    assert off_circle(moved).mean() < 0.4


def test_an_outline_is_drawn_again_if_its_anchors_are_not_in_order(contour: Contour, wire: LiveWire):
    # A sheet so thin that its other side is nearer to an anchor than the anchor's own side.
    turned = replace(contour, outline=contour.outline[::-1])
    moved = anchor_moved(turned, wire, 1, contour.anchors[1])
    assert len(moved.outline) == len(contour.outline)
    assert off_circle(moved).mean() < 0.25
