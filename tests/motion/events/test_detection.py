from dataclasses import replace

import numpy as np
import pytest
from tests import made_stairs, made_steps

from marey.errors import MareyError
from marey.motion.events.cycles import OFF, STRIKE
from marey.motion.events.detection import EventSettings, find_events
from marey.motion.events.feet import FootPath, WalkPaths, direction_of_progression, fine_feet, ground_velocity
from marey.motion.events.methods import find_extremes, landing_point


def times(paths: WalkPaths, kind: str, side: str, **options) -> np.ndarray:
    found = find_events(paths, **options)
    return np.array([e.time for e in found if (e.kind, e.side) == (kind, side)])


def moved(paths: WalkPaths, rotation: np.ndarray, shift: np.ndarray) -> WalkPaths:
    def place(points: np.ndarray) -> np.ndarray:
        return np.einsum("...ab,...b->...a", rotation, points) + shift

    feet = [FootPath(side=f.side, heel=place(f.heel), toe=None if f.toe is None else place(f.toe)) for f in paths.feet]
    return WalkPaths(body=place(paths.body), feet=tuple(feet), rate=paths.rate, start_s=paths.start_s)


def about_z(angle: np.ndarray | float) -> np.ndarray:
    c, s, zero = np.cos(angle), np.sin(angle), 0 * np.asarray(angle)
    return np.stack([np.stack([c, -s, zero], -1), np.stack([s, c, zero], -1), np.stack([zero, zero, zero + 1], -1)], -2)


@pytest.mark.parametrize("rate", [30.0, 100.0, 240.0])
def test_every_strike_is_found_within_half_a_frame_and_the_method_s_own_error(rate: float):
    for side in ("left", "right"):
        found = times(made_steps.made_walk(rate), STRIKE, side)
        true = made_steps.strikes(side)
        assert len(found) == len(true)
        assert np.abs(found - true).max() < 0.5 / rate + 0.01


def test_offs_follow_the_last_rest_of_the_toe_at_equal_intervals():
    found = times(made_steps.made_walk(), OFF, "left")
    resting = made_steps.strikes("left")[:-1] + made_steps.OFF_SHARE * made_steps.CYCLE_S
    late = found - resting
    assert np.ptp(late) < 1e-6  # all steps are equal
    assert 0.03 < late.mean() < 0.06  # a toe is lifted about 0.046 s after it has begun to move


def test_a_belt_a_turned_room_and_a_later_start_change_no_event():
    walk = made_steps.made_walk()
    events = find_events(walk)
    for other in (
        made_steps.made_walk(belt=True), moved(walk, about_z(2.0), np.array([3.0, -1.0, 0.2])),
        replace(walk, start_s=7.0),
    ):  # fmt: skip
        same = find_events(other)
        assert [(e.kind, e.side) for e in same] == [(e.kind, e.side) for e in events]
        np.testing.assert_allclose(
            [e.time - other.start_s for e in same], [e.time for e in events], atol=1 / 240
        )  # fmt: skip


def test_a_walk_on_a_circle_has_the_events_of_the_straight_one():
    """A turn of 90 degrees in three cycles; a direction for the whole trial would exchange fore and aft by its end."""
    walk = made_steps.made_walk(seconds=8.0)
    radius = (made_steps.STRIDE_M / made_steps.CYCLE_S) / np.radians(27.0)

    def bent(points: np.ndarray) -> np.ndarray:
        angle = points[:, 0] / radius
        out = radius - points[:, 1]
        return np.stack([out * np.sin(angle), radius - out * np.cos(angle), points[:, 2]], -1)

    feet = [FootPath(side=f.side, heel=bent(f.heel), toe=bent(f.toe)) for f in walk.feet if f.toe is not None]
    circle = WalkPaths(body=bent(walk.body), feet=tuple(feet), rate=walk.rate)
    straight, turned = find_events(walk), find_events(circle)
    assert [(e.kind, e.side) for e in turned] == [(e.kind, e.side) for e in straight]
    np.testing.assert_allclose([e.time for e in turned], [e.time for e in straight], atol=0.01)


def test_direction_and_ground_are_those_of_the_belt_or_of_the_body():
    walk, belt = made_steps.made_walk(), made_steps.made_walk(belt=True)
    for paths in (walk, belt):
        np.testing.assert_allclose(direction_of_progression(paths), np.tile([1.0, 0.0, 0.0], (500, 1)), atol=1e-6)
    np.testing.assert_array_equal(ground_velocity(walk), 0.0)
    np.testing.assert_allclose(ground_velocity(belt), [-1.2, 0.0, 0.0], atol=1e-6)
    heels = made_steps.made_walk(belt=True, toes=False)
    np.testing.assert_allclose(direction_of_progression(heels), np.tile([1.0, 0.0, 0.0], (500, 1)), atol=1e-6)


def test_noise_and_low_rates_widen_the_standard_deviation_and_keep_the_events():
    rng = np.random.default_rng(3)
    walk = made_steps.made_walk(100.0, 9.0)
    feet = [
        FootPath(side=f.side, heel=f.heel + rng.normal(0, 0.002, f.heel.shape), toe=f.toe)
        for f in walk.feet if f.toe is not None
    ]  # fmt: skip
    noisy, clean = find_events(replace(walk, feet=tuple(feet))), find_events(walk)
    assert [(e.kind, e.side) for e in noisy] == [(e.kind, e.side) for e in clean]
    off = np.array([(a.time - b.time) / (a.sd_s or 0.0) for a, b in zip(noisy, clean, strict=True)])
    assert np.abs(off).max() < 4
    slow = find_events(made_steps.made_walk(25.0, 9.0))
    assert np.mean([e.sd_s for e in slow]) > np.mean([e.sd_s for e in clean])


def test_a_gap_costs_the_events_inside_it_only():
    walk = made_steps.made_walk(seconds=8.0)
    left, right = walk.feet
    heel = np.array(left.heel)
    heel[380:420] = np.nan  # about the fourth strike, at 3.6 s in the middle of the trial
    found = times(replace(walk, feet=(replace(left, heel=heel), right)), STRIKE, "left")
    whole = times(walk, STRIKE, "left")
    missing = [t for t in whole if np.abs(found - t).min() > 0.02]
    assert all(3.7 < t < 4.3 for t in missing)


def test_feet_that_stand_or_shuffle_in_place_have_no_events():
    time = np.arange(500) / 100
    sway = 0.03 * np.stack([np.sin(2 * time), np.cos(3 * time), 0 * time], -1)
    feet = tuple(
        FootPath(side=s, heel=sway + [0, y, 0.03], toe=sway + [0.2, y, 0.03])
        for s, y in (("left", 0.1), ("right", -0.1))
    )  # fmt: skip
    assert find_events(WalkPaths(body=sway + [0, 0, 0.9], feet=feet, rate=100.0)) == ()


def test_unseen_feet_and_short_trials_have_no_events():
    walk = made_steps.made_walk()
    unseen = np.full((500, 3), np.nan)
    hidden = tuple(replace(foot, heel=unseen) for foot in walk.feet)
    assert find_events(replace(walk, feet=hidden)) == ()
    short = FootPath(side="left", heel=np.zeros((3, 3)))
    assert find_events(WalkPaths(body=np.zeros((3, 3)), feet=(short,), rate=100.0)) == ()


def test_paths_of_different_lengths_are_an_error():
    with pytest.raises(MareyError, match="different numbers of frames"):
        WalkPaths(body=np.zeros((4, 3)), feet=(FootPath(side="left", heel=np.zeros((5, 3))),), rate=100.0)


def test_two_events_of_a_foot_are_never_closer_than_the_shortest_step():
    walk = made_steps.made_walk()
    rare = times(walk, STRIKE, "left", settings=EventSettings(shortest_step_s=2.0))
    assert len(rare) == 3
    assert np.diff(rare).min() > 2.0


def test_real_force_plates_agree_within_the_stated_standard_deviations(shared):
    from marey.io.markers.c3d_forces import read_force_plates
    from marey.io.markers.readers import read_markers
    from marey.markers.preprocessing.gait_events import events_from_force

    file = shared / "data" / "markers" / "functional" / "walk.c3d"
    walk = read_markers(file)

    def path(side: str, end: str) -> np.ndarray:
        return walk.select([f"{side[0].upper()}{end}"]).points[:, 0]

    feet = tuple(FootPath(side=s, heel=path(s, "HEE"), toe=path(s, "TOE")) for s in ("left", "right"))
    body = walk.select(["LASI", "RASI", "LPSI", "RPSI"]).points.mean(1)
    found = find_events(WalkPaths(body=body, feet=feet, rate=walk.rate, start_s=walk.start_s))
    force = events_from_force(
        read_force_plates(file), {foot.side: foot.heel for foot in feet}, rate=walk.rate, start_s=walk.start_s
    )  # fmt: skip
    assert len(force) == 6
    for event in force:
        own = [e for e in found if (e.kind, e.side) == (event.kind, event.side)]
        nearest = min(own, key=lambda e: abs(e.time - event.time))
        assert abs(nearest.time - event.time) < 2 * (nearest.sd_s or 0.0)


def test_the_noise_of_standing_feet_is_estimated_at_any_rate():
    """White noise of 3 mm; the estimate from about 40 values of each axis scatters by 8 %, and rates add curvature."""
    rng = np.random.default_rng(11)
    for rate in (50.0, 100.0, 240.0):
        walk = made_steps.made_walk(rate, 9.0)
        feet = [FootPath(side=f.side, heel=f.heel + rng.normal(0, 0.003, f.heel.shape), toe=f.toe) for f in walk.feet]
        for foot in fine_feet(replace(walk, feet=tuple(feet)), cutoff_hz=20.0):
            assert foot.noise_m == pytest.approx(0.003, rel=0.25)
        for foot in fine_feet(walk, cutoff_hz=20.0):
            assert foot.noise_m < 0.0005


@pytest.mark.parametrize("steps", made_stairs.STAIRS.values(), ids=made_stairs.STAIRS)
@pytest.mark.parametrize("rate", [60.0, 100.0])
def test_strikes_are_found_on_stairs_whichever_part_of_the_foot_lands_first(steps, rate):
    """The error of the better method is 8 ms, and the made feet land more softly than real ones."""
    for side in ("left", "right"):
        found = times(made_stairs.stair_walk(steps, rate=rate), STRIKE, side)
        true = made_stairs.stair_strikes(steps, side)
        assert len(found) == len(true)
        assert np.abs(found - true).max() < 0.016


def test_the_front_lands_first_only_where_the_heel_follows_it():
    walks = {"walk": (made_steps.made_walk(), False)}
    walks |= {name: (made_stairs.stair_walk(steps), "toe" in name or "front" in name)
              for name, steps in made_stairs.STAIRS.items()}  # fmt: skip
    for name, (walk, toe_first) in walks.items():
        without = replace(walk, feet=tuple(FootPath(side=foot.side, heel=foot.heel) for foot in walk.feet))
        for foot in (*fine_feet(walk, cutoff_hz=20.0), *fine_feet(without, cutoff_hz=20.0)):
            whole = [swing for swing in find_extremes(foot).strikes if swing.window.stop < len(foot.time)]
            lands = [landing_point(foot, swing).heel is foot.toe for swing in whole]
            assert lands == [toe_first and foot.toe is not None] * len(whole), name
