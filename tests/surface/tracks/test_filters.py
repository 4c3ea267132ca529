import numpy as np
import pytest

from marey.errors import SettingProblem
from marey.geometry import rotations
from marey.surface.tracks.filters import FilterSettings, filtered, too_fast
from marey.surface.tracks.trajectories import Trajectories, derivatives

RATE, FRAMES = 30.0, 20


def moving_grid(rng, *, noise=1e-4) -> np.ndarray:
    """A square of skin (F, N, 3) that swings like a forearm: up to 2 m/s, and turning [m]."""
    x, z = np.meshgrid(np.arange(0.0, 0.1, 0.01), np.arange(0.2, 0.3, 0.01))
    points = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=-1)
    turns = rotations.exp(np.outer(1 - np.cos(np.linspace(0, np.pi, FRAMES)), [0.5, 0.3, 0.0]))
    return np.einsum("fij,nj->fni", turns, points) + rng.normal(0, noise, (FRAMES, len(points), 3))


def trajectories(position: np.ndarray) -> Trajectories:
    velocity, acceleration = derivatives(position, rate=RATE)
    shape = position.shape[:2]
    return Trajectories(
        frames=np.arange(len(position)), rate=RATE, position=position, velocity=velocity, acceleration=acceleration,
        covariance=np.zeros((*shape, 3, 3)), camera_names=("a", "b"), pixels=np.zeros((*shape, 2, 2)),
        removed=np.zeros(shape[1], bool),
    )  # fmt: skip


def test_what_is_true_stays_as_it_is(rng):
    position = moving_grid(rng)
    done = filtered(trajectories(position), FilterSettings())
    np.testing.assert_allclose(done.trajectories.position, position, atol=1e-6)
    assert not done.trajectories.removed.any()
    assert (done.too_fast, done.unlike, done.short) == (0, 0, 0)


def test_a_jump_truncates_a_trajectory(rng):
    position = moving_grid(rng)
    position[14:, 44] += [0.0, 0.0, 0.012]
    done = filtered(trajectories(position), FilterSettings()).trajectories
    assert done.measured[:14, 44].all()
    assert not done.measured[14:, 44].any()
    assert not done.removed.any()
    assert done.measured[:, np.arange(100) != 44].all()
    # Velocities are those of what is left.
    assert np.isnan(done.velocity[14:, 44]).all()
    assert np.linalg.norm(done.velocity[13, 44] - done.velocity[13, 43]) < 0.2


def test_a_point_false_at_its_start_is_taken_out_there(rng):
    position = moving_grid(rng)
    position[:3, 55] += [0.0, 0.015, 0.0]
    done = filtered(trajectories(position), FilterSettings()).trajectories
    assert not done.measured[:3, 55].any()
    assert done.measured[3:, 55].all()


def test_slow_wandering_shows_in_the_sum(rng):
    position = moving_grid(rng)
    position[:, 33] += np.linspace(0, 1, FRAMES)[:, None] * [0.006, 0.0, 0.006]
    done = filtered(trajectories(position), FilterSettings(least_apart=0.002, frames=3)).trajectories
    left = done.measured[:, 33]
    assert left[:4].all()
    assert not left[12:].any()


def test_what_is_nothing_but_false_is_removed_whole(rng):
    position = moving_grid(rng)
    position[:, 70] += rng.normal(0, 0.02, (FRAMES, 3))
    done = filtered(trajectories(position), FilterSettings())
    assert np.flatnonzero(done.trajectories.removed).tolist() == [70]
    # Removed trajectories stay in the result.
    np.testing.assert_allclose(done.trajectories.position[:, 70], position[:, 70], atol=1e-6)


def test_given_thresholds_cut_what_is_faster(rng):
    position = moving_grid(rng, noise=0.0)
    speed = np.linalg.norm(np.diff(position, axis=0), axis=-1) * RATE
    cuts, limit, _ = too_fast(position, rate=RATE, settings=FilterSettings(speed=0.8 * speed.max()))
    assert limit == pytest.approx(0.8 * speed.max())
    np.testing.assert_array_equal(cuts[1:], speed > limit)
    _, limit, change = too_fast(position, rate=RATE, settings=FilterSettings())
    assert limit == pytest.approx(3 * np.percentile(speed, 99))
    assert change > 0


def test_gaps_are_no_jumps_and_a_false_point_after_one_is_found(rng):
    position = moving_grid(rng)
    position[6:10, 45:49] = np.nan
    # It comes back on another place of the surface.
    position[10:, 47] += 0.8 * (position[10:, 48] - position[10:, 47])
    done = filtered(trajectories(position), FilterSettings()).trajectories
    assert done.measured[10:, 45].all()
    assert done.measured[:6, 47].sum() == 0
    assert done.measured[10:, 47].all()


def test_short_trajectories_are_removed_but_not_all_of_a_short_video(rng):
    position = moving_grid(rng)
    position[3:, 5] = np.nan
    done = filtered(trajectories(position), FilterSettings(frames=5))
    assert np.flatnonzero(done.trajectories.removed).tolist() == [5]
    assert done.short == 1
    brief = filtered(trajectories(position[:3]), FilterSettings(frames=5))
    assert not brief.trajectories.removed.any()


def test_points_without_neighbours_are_judged_by_the_thresholds_alone(rng):
    position = moving_grid(rng)[:, [0, 99]]
    done = filtered(trajectories(position), FilterSettings()).trajectories
    assert done.measured.all()
    empty = filtered(trajectories(np.zeros((4, 0, 3))), FilterSettings())
    assert len(empty.trajectories) == 0


@pytest.mark.parametrize("given", [{"speed": 0.0}, {"acceleration": -1.0}, {"sigmas": 0.0}, {"frames": 0}])
def test_impossible_settings_are_rejected(given):
    with pytest.raises(SettingProblem, match=f"{next(iter(given))} is"):
        FilterSettings(**given)
