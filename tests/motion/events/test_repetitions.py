import math

import numpy as np
import pytest

from marey.arrays import Floats
from marey.motion.events.feet import FootPath, WalkPaths
from marey.motion.events.repetitions import Flight, find_repetitions, with_largest_angles

GRAVITY = 9.80665
RATE = 60.0


def paths_of(height: Floats, lift: Floats | float = 0.0, *, noise_m: float = 0.0, rate: float = RATE) -> WalkPaths:
    """Paths of a person who stands in place, with the pelvis and both feet at given heights (F,)."""
    rng, count = np.random.default_rng(3), len(height)

    def point(x: float, y: float, z: Floats) -> Floats:
        return np.stack([np.full(count, x), np.full(count, y), z], 1) + rng.normal(0, noise_m, (count, 3))

    feet = [
        FootPath(
            side=side,
            heel=point(-0.1, y, 0.03 + lift + np.zeros(count)),
            toe=point(0.1, y, 0.02 + lift + np.zeros(count)),
        )
        for side, y in (("left", 0.1), ("right", -0.1))
    ]
    return WalkPaths(body=point(0.0, 0.0, height), feet=tuple(feet), rate=rate)


def eased(time: Floats, start: float, end: float) -> Floats:
    """From 0 to 1 between two instants, at rest before and after."""
    share = np.clip((time - start) / (end - start), 0, 1)
    return (1 - np.cos(np.pi * share)) / 2


def squats(time: Floats, starts: tuple[float, ...], depth: float, half_s: float = 0.8) -> Floats:
    """Height of a pelvis that goes down and up again from each start."""
    down = sum(eased(time, s, s + half_s) - eased(time, s + half_s, s + 2 * half_s) for s in starts)
    return 0.95 - depth * down


@pytest.mark.parametrize("noise_m", [0.0, 0.002])
def test_squats_have_their_times_and_depths(noise_m):
    time = np.arange(0, 8, 1 / RATE)
    found = find_repetitions(paths_of(squats(time, (1.0, 4.5), 0.4), noise_m=noise_m))
    assert [each.kind for each in found] == ["squat", "squat"]
    for each, start in zip(found, (1.0, 4.5), strict=True):
        # 5 % of a cosine ramp of 0.8 s is reached after 0.115 s
        assert each.start_s == pytest.approx(start + 0.115, abs=0.03)
        assert each.lowest_s == pytest.approx(start + 0.8, abs=0.03)
        assert each.end_s == pytest.approx(start + 1.6 - 0.115, abs=0.03)
        assert each.depth_m == pytest.approx(0.95 * 0.4, abs=0.003 + 3 * each.depth_sd_m)
        assert each.flight is None
    assert found[0].depth_sd_m == pytest.approx(math.sqrt(2) * noise_m, rel=0.5, abs=1e-5)


def test_sitting_down_and_standing_up_are_apart():
    time = np.arange(0, 8, 1 / RATE)
    height = 0.95 - 0.4 * (eased(time, 1.0, 2.2) - eased(time, 5.0, 6.0))
    lowering, rising = find_repetitions(paths_of(height))
    assert (lowering.kind, rising.kind) == ("lowering", "rising")
    assert 1.0 < lowering.start_s < lowering.end_s < 2.3
    assert 4.9 < rising.start_s < rising.end_s < 6.0
    assert lowering.depth_m == pytest.approx(0.38, abs=0.02)


def test_a_recording_that_begins_on_a_seat_has_the_rising_alone():
    time = np.arange(0, 4, 1 / RATE)
    (rising,) = find_repetitions(paths_of(0.5 + 0.4 * eased(time, 1.5, 2.5)))
    assert rising.kind == "rising"
    assert 1.4 < rising.start_s < rising.end_s < 2.5


def jump(time: Floats, takeoff: float, height: float) -> tuple[Floats, Floats, float]:
    """Height of pelvis and feet in a jump with a countermovement, and the landing."""
    speed = math.sqrt(2 * GRAVITY * height)
    landing = takeoff + 2 * speed / GRAVITY
    air = (time > takeoff) & (time < landing)
    rise = np.where(air, speed * (time - takeoff) - GRAVITY * (time - takeoff) ** 2 / 2, 0.0)
    # down 0.25 m, then up with the speed of the take-off; after landing the same in reverse
    push_s, dip = 0.3, 0.25

    def bend(since: Floats) -> Floats:
        share = np.clip(since / push_s, 0, 1)
        # from depth `dip` at rest to 0 with the given speed
        return -dip * (1 - share) ** 2 * (1 + 2 * share) + speed * push_s * share**2 * (share - 1)

    before = np.where(
        time < takeoff - push_s, -dip * eased(time, takeoff - 1.0, takeoff - push_s), bend(time - takeoff + push_s)
    )
    after = np.where(
        time > landing + push_s,
        -dip * (1 - eased(time, landing + push_s, landing + 1.0)),
        bend(landing + push_s - time),
    )
    pelvis = 0.95 + np.where(air, rise, np.where(time <= takeoff, before, after))
    return pelvis, rise, landing


@pytest.mark.parametrize(("height", "rate"), [(0.05, 60.0), (0.3, 60.0), (0.3, 30.0), (0.3, 240.0)])
def test_a_jump_has_the_height_and_the_instants_it_was_made_with(height, rate):
    time = np.arange(0, 4, 1 / rate)
    pelvis, lift, landing = jump(time, 1.8, height)
    (found,) = find_repetitions(paths_of(pelvis, lift, rate=rate))
    assert found.kind == "jump"
    flight = found.flight
    assert flight is not None
    # The feet leave the floor with a corner, which a spline through the frames rounds: within half a frame.
    assert flight.takeoff_s == pytest.approx(1.8, abs=0.003 + 0.5 / rate)
    assert flight.landing_s == pytest.approx(landing, abs=0.003 + 0.5 / rate)
    assert abs(flight.height_m - height) < 3 * flight.height_sd_m
    assert found.end_s == flight.landing_s
    assert found.depth_m == pytest.approx(0.25, abs=0.03)
    assert found.start_s < found.lowest_s < flight.takeoff_s


def noisy_jump(seed: int, foot_m: float, body_m: float) -> tuple[Flight, float, float]:
    """A found flight, and its true instants, of a person whose feet and pelvis have noise of their own."""
    rng, time = np.random.default_rng(seed), np.arange(0, 4, 1 / RATE)
    takeoff = 2.0 + rng.uniform(0, 1 / RATE)
    pelvis, lift, landing = jump(time, takeoff, 0.25)
    still = paths_of(pelvis, lift)
    feet = tuple(
        FootPath(side=foot.side, heel=noisy(rng, foot.heel, foot_m), toe=noisy(rng, np.asarray(foot.toe), foot_m))
        for foot in still.feet
    )
    (found,) = find_repetitions(WalkPaths(body=noisy(rng, still.body, body_m), feet=feet, rate=RATE))
    assert found.flight is not None
    return found.flight, takeoff, landing


def noisy(rng: np.random.Generator, path: Floats, sd_m: float) -> Floats:
    """A path with noise."""
    return np.asarray(path + rng.normal(0, sd_m, path.shape))


def test_the_deviation_of_the_instants_follows_from_the_noise_of_the_feet():
    found = [noisy_jump(seed, 0.008, 0.0005) for seed in range(60)]
    errors = np.array([(flight.takeoff_s - takeoff, flight.landing_s - landing) for flight, takeoff, landing in found])
    sds = np.array([flight.sd_s for flight, _, _ in found])
    assert 0.9 <= (np.abs(errors) < 1.96 * sds[:, None]).mean() <= 1.0
    assert 0.5 < np.sqrt((errors**2).mean() / (sds**2).mean()) < 1.3
    of_the_body = noisy_jump(0, 0.0005, 0.004)[0].sd_s
    assert of_the_body == pytest.approx(1 / RATE / math.sqrt(12), rel=0.05)


def test_a_landing_is_no_squat_and_a_rebound_starts_with_it():
    time = np.arange(0, 6, 1 / RATE)
    first, lift, landing = jump(time, 1.8, 0.2)
    second, other, _ = jump(time, landing + 0.6, 0.2)
    between = landing + 0.3
    pelvis, feet = np.where(time < between, first, second), np.where(time < between, lift, other)
    found = find_repetitions(paths_of(pelvis, feet))
    assert [each.kind for each in found] == ["jump", "jump"]
    assert found[1].start_s == pytest.approx(landing, abs=0.02)


def test_feet_in_the_air_without_a_fall_are_no_jump():
    time = np.arange(0, 4, 1 / RATE)
    hanging = 0.3 * (eased(time, 1.0, 1.5) - eased(time, 2.5, 3.0))
    assert all(each.flight is None for each in find_repetitions(paths_of(0.95 + hanging, hanging)))


def test_a_step_to_another_place_is_none():
    time = np.arange(0, 4, 1 / RATE)
    paths = paths_of(squats(time, (1.0,), 0.3))
    moved = np.outer(eased(time, 1.5, 2.5), [0.4, 0.0, 0.0])
    feet = tuple(FootPath(side=f.side, heel=f.heel + moved, toe=f.toe + moved) for f in paths.feet if f.toe is not None)
    assert find_repetitions(WalkPaths(body=paths.body, feet=feet, rate=RATE)) == ()


def test_swaying_is_none_and_gaps_part_the_motion():
    time = np.arange(0, 8, 1 / RATE)
    assert find_repetitions(paths_of(0.95 + 0.015 * np.sin(2 * time))) == ()
    height = squats(time, (1.0, 4.5), 0.4)
    height[200:210] = np.nan  # between the two
    assert [each.kind for each in find_repetitions(paths_of(height))] == ["squat", "squat"]
    height[100:105] = np.nan  # in the first one
    assert [each.kind for each in find_repetitions(paths_of(height))][-1] == "squat"
    assert find_repetitions(paths_of(np.full(100, np.nan))) == ()


def test_the_largest_angles_are_those_within_each_repetition():
    time = np.arange(0, 8, 1 / RATE)
    entries = find_repetitions(paths_of(squats(time, (1.0, 4.5), 0.4)))
    knee = (
        100 * eased(time, 1.0, 1.8)
        - 100 * eased(time, 1.8, 2.6)
        + 60 * eased(time, 4.5, 5.3)
        - 60 * eased(time, 5.3, 6.1)
    )
    values = np.stack([knee, np.full_like(knee, np.nan), knee], 1)
    found = with_largest_angles(entries, ("left_knee_flexion", "knee_angle_r", "left_elbow_flexion"), values, time)
    assert found.angle_names == ("left_knee_flexion", "knee_angle_r")
    np.testing.assert_allclose(found.largest_deg[:, 0], [100, 60], atol=0.5)
    assert np.isnan(found.largest_deg[:, 1]).all()
    assert len(found) == len(list(found)) == 2
