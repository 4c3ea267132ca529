"""Faults of tracks: what is found, where, and how much its undoing explains; sound tracks have none."""

from dataclasses import replace

import numpy as np
import pytest

from marey.nonrigid.core.track_faults import ALL_BY_NAME, TRACK_FAULT_DEFAULTS, track_faults

FRAMES, POINTS = 40, 9


@pytest.fixture(scope="module")
def places() -> np.ndarray:
    """Points that move along smooth curves, (40, 2, 9), far from the origin."""
    rng, when = np.random.default_rng(5), np.arange(FRAMES)[:, None, None]
    middle, wide, phase = (rng.uniform(*each, (2, POINTS)) for each in ((300, 600), (20, 40), (0, 6)))
    return middle + wide * np.sin(when / 6 + phase) + rng.normal(0, 0.2, (FRAMES, 1, 1))


def kinds(places: np.ndarray, **more: object) -> list[str]:
    return [fault.kind for fault in track_faults(places, **more)]  # type: ignore[arg-type]


@pytest.mark.parametrize("factor", [1e-3, 1.0, 1e3])
def test_faults_do_not_depend_on_the_unit_or_a_shift_of_all_places(places, factor):
    wrong = places.copy()
    wrong[20:, :, [1, 7]] = wrong[20:, :, [7, 1]]
    assert kinds(factor * places) == []
    [own], [other] = track_faults(wrong), track_faults(factor * wrong + 50 * factor)
    for fault in (own, other):
        assert (fault.kind, fault.frames, fault.points) == ("exchanged", (20,), (1, 7))
    assert other.before == pytest.approx(factor * own.before)
    assert other.after == pytest.approx(factor * own.after)


def test_exchanging_back_leaves_what_the_noise_leaves(places):
    wrong = places.copy()
    wrong[11:, :, [0, 4]] = wrong[11:, :, [4, 0]]
    [fault] = track_faults(wrong)
    ahead = 2 * places[10] - places[9]
    assert fault.after == pytest.approx(np.linalg.norm(places[11][:, [0, 4]] - ahead[:, [0, 4]]))
    assert fault.before == pytest.approx(np.linalg.norm(places[11][:, [4, 0]] - ahead[:, [0, 4]]))
    assert fault.count == FRAMES - 11


def test_tracks_that_are_exchanged_twice_are_exchanged_from_two_frames_on(places):
    wrong = places.copy()
    wrong[8:25, :, [2, 3]] = wrong[8:25, :, [3, 2]]
    found = track_faults(wrong)
    assert [(fault.frames, set(fault.points)) for fault in found] == [((8,), {2, 3}), ((25,), {2, 3})]


def test_zeros_are_counted_in_each_view_for_itself(places):
    views = np.concatenate([places, places[:, ::-1]], 1)
    views[5:8, 2:, 3] = 0.0
    [fault] = track_faults(views, views=2)
    assert (fault.kind, fault.frames, fault.points, fault.count) == ("zeros", (5, 6, 7), (3,), 3)
    # One view, whose other coordinates are not zero, has no missing place.
    assert "zeros" not in kinds(views)


def test_a_point_that_passes_near_zero_is_not_missing(places):
    near = places - places[20, :, :1]
    near[20, :, 0] = 0.0
    assert kinds(near) == []


@pytest.mark.parametrize("start", [0, 1])
def test_the_order_of_names_is_undone_whether_frames_are_counted_from_0_or_1(start):
    # Of more than 1000 frames either order makes the steps smaller, but only one is right.
    when = np.arange(1100)[:, None, None]
    places = 500 + np.cumsum(np.full((1100, 2, 5), 0.5), 0) + np.sin(when / 9 + np.arange(5))
    by_name = np.argsort([str(n) for n in range(start, start + len(places))])
    [fault] = track_faults(places[by_name])
    assert (fault.kind, fault.count) == ("order", ALL_BY_NAME)
    assert fault.after == pytest.approx(np.sqrt((np.diff(places, axis=0) ** 2).sum((1, 2)) / 5).sum())


def test_frames_that_are_moved_and_tracks_that_are_exchanged_are_named_with_frames_of_the_input(places):
    wrong = places.copy()
    wrong[30:, :, [5, 6]] = wrong[30:, :, [6, 5]]
    order = np.insert(np.delete(np.arange(FRAMES), 10), 24, 10)
    moved, exchanged = track_faults(wrong[order])
    assert (moved.kind, moved.frames, moved.count) == ("order", (24,), 1)
    assert moved.after < TRACK_FAULT_DEFAULTS.largest_order_ratio * moved.before
    assert (exchanged.kind, exchanged.frames, set(exchanged.points)) == ("exchanged", (30,), {5, 6})


def test_more_frames_out_of_order_than_can_be_moved_one_by_one_are_not_explained(places):
    assert "order" not in kinds(places[np.random.default_rng(0).permutation(FRAMES)])


def test_repeated_frames_are_found_with_the_same_points_missing_only(places):
    gone = places.copy()
    gone[:, :, 2] = np.nan
    gone[9] = gone[8]
    [fault] = track_faults(gone)
    assert (fault.kind, fault.frames, fault.count) == ("repeated", (9,), 1)
    gone[9, :, 4] = np.nan
    assert "repeated" not in kinds(gone)
    # Points that do not move at all are no repeated frames.
    assert kinds(np.repeat(places[:1], 6, 0)) == []


def test_a_threshold_above_every_jump_finds_no_exchange(places):
    wrong = places.copy()
    wrong[20:, :, [1, 7]] = wrong[20:, :, [7, 1]]
    assert "exchanged" not in kinds(wrong, settings=replace(TRACK_FAULT_DEFAULTS, jump=1e6))
