"""Things in front of the person: a disc moves through an image, and something hides it there."""

import numpy as np
import pytest

from marey.images.silhouettes.occluders import CoverCounts, OccluderSettings, StaticOccluder, divided

SIZE = (120, 80)
RADIUS, REACH = 16, 3
SETTINGS = OccluderSettings()


def disc(column, row, radius=RADIUS):
    rows, columns = np.indices(SIZE[::-1])
    return np.hypot(columns - column, rows - row) <= radius


def counts_of(places, hides, *, edges=(2.0, 6.0)):
    """Discs at columns and distances, of which an image shows what `hides` leaves at that distance."""
    counts = CoverCounts(SIZE, np.array(edges))
    for column, distance in places:
        body = disc(column, 40)
        certain = disc(column, 40, RADIUS - REACH)
        counts.add(np.where(body, distance, np.inf), certain, body & ~hides(distance))
    return counts


@pytest.fixture
def bar():
    thing = np.zeros(SIZE[::-1], bool)
    thing[40:52, 30:90] = True
    return thing


def test_a_thing_is_found_where_it_hides_the_body_and_nowhere_else(bar):
    columns = range(20, 100, 2)
    found = counts_of([(column, 4.0) for column in columns], lambda distance: bar).occluder(SETTINGS)
    covered = np.any([disc(column, 40) for column in columns], axis=0)
    hidden = found.hides(4.0)
    assert not (hidden & ~bar).any()
    # The edge of the covered region is seen by no disc that is certain there.
    assert np.count_nonzero(hidden & bar) > 0.97 * np.count_nonzero(bar & covered)
    assert found.share == pytest.approx(np.count_nonzero(hidden) / hidden.size)


def test_without_a_thing_nothing_is_found(rng):
    def noise(distance):
        return rng.random(SIZE[::-1]) < 0.3  # clothes of the colour of the room in three of ten images

    assert counts_of([(column, 4.0) for column in range(20, 100, 2)], noise).occluder(SETTINGS).share == 0


def test_a_body_too_large_by_less_than_the_reach_makes_no_thing():
    counts = CoverCounts(SIZE, np.array([2.0, 6.0]))
    for _ in range(60):
        counts.add(np.where(disc(60, 40), 4.0, np.inf), disc(60, 40, RADIUS - REACH), disc(60, 40, RADIUS - REACH))
    assert counts.occluder(SETTINGS).share == 0


def test_a_thing_between_two_distances_hides_the_far_body_only(bar):
    places = [(column, distance) for column in range(20, 100, 2) for distance in (3.0, 5.0)]
    counts = counts_of(places, lambda distance: bar & (distance > 4.0), edges=(2.5, 3.5, 4.5, 5.5))
    found = counts.occluder(SETTINGS)
    assert not found.hides(3.0).any()
    assert np.count_nonzero(found.hides(5.0)) > 0.8 * np.count_nonzero(bar)
    # A distance of each pixel, as of an arm that reaches over the thing.
    distance = np.full(SIZE[::-1], 5.0)
    distance[:, 60:] = 3.0
    assert not found.hides(distance)[:, 60:].any()


def test_a_pixel_that_few_images_cover_is_not_hidden(bar):
    few = [(60, 4.0)] * (SETTINGS.least_covered - 1)
    assert counts_of(few, lambda distance: bar).occluder(SETTINGS).share == 0
    assert counts_of([*few, (60, 4.0)], lambda distance: bar).occluder(SETTINGS).share > 0


def test_another_size_shows_the_same_thing(bar):
    thing = StaticOccluder(np.where(bar, 3.0, np.inf))
    assert thing.resized(SIZE) is thing
    np.testing.assert_array_equal(thing.resized((60, 40)).hides(3.0), bar[::2, ::2])


def test_a_region_is_divided_by_what_is_seen_before_the_thing(bar):
    silhouette = disc(60, 30) & ~bar
    hand, thread = np.zeros((2, *bar.shape), bool)
    hand[42:50, 60:70] = True
    thread[45, 35:50] = True
    visible, hidden = divided(silhouette | hand | thread, bar)
    np.testing.assert_array_equal(visible, silhouette | hand)
    np.testing.assert_array_equal(hidden, bar & ~hand)
