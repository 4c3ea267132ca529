import numpy as np
import pytest

from marey.errors import SettingProblem
from marey.surface.tracks.trajectories import Sightings, Trajectories, derivatives, gathered


def test_derivatives_of_a_parabola_are_exact_up_to_its_ends():
    time = np.arange(12) / 50
    position = np.stack([1 + 2 * time + 3 * time**2, 0.5 * time, -(time**2)], axis=-1)[:, None]
    velocity, acceleration = derivatives(position, rate=50.0)
    np.testing.assert_allclose(velocity[:, 0, 0], 2 + 6 * time, atol=1e-9)
    np.testing.assert_allclose(velocity[:, 0, 2], -2 * time, atol=1e-9)
    np.testing.assert_allclose(acceleration[:, 0], np.broadcast_to([6.0, 0.0, -2.0], (12, 3)), atol=1e-8)


def test_no_gap_is_bridged():
    position = np.zeros((9, 1, 3))
    position[4] = np.nan
    position[5:] = 7.0
    position[8] = np.nan
    velocity, acceleration = derivatives(position, rate=1.0)
    np.testing.assert_allclose(velocity[np.isfinite(position)], 0, atol=1e-12)
    assert np.isnan(velocity[4]).all()
    lonely = np.full((5, 1, 3), np.nan)
    lonely[1], lonely[3:] = 1.0, [[[1.0, 2, 3]], [[2.0, 4, 6]]]
    velocity, acceleration = derivatives(lonely, rate=10.0)
    assert np.isnan(velocity[:3]).all()
    np.testing.assert_allclose(velocity[3:, 0], [[10, 20, 30], [10, 20, 30]])
    assert np.isnan(acceleration).all()


def sightings(frame, count, which):
    n = len(which)
    return Sightings(
        frame=frame, count=count, which=np.array(which), position=np.full((n, 3), frame + 0.25),
        covariance=np.tile(np.eye(3), (n, 1, 1)), pixels=np.full((n, 2, 2), 5.0 * frame),
    )  # fmt: skip


def test_frames_are_gathered_row_by_row():
    rows = [sightings(3, 2, [0, 1]), sightings(4, 4, [1, 3])]
    got = gathered(rows, np.arange(6), rate=25.0, camera_names=("a", "b"))
    assert np.argwhere(got.measured).tolist() == [[3, 0], [3, 1], [4, 1], [4, 3]]
    assert got.position[4, 3, 0] == 4.25
    assert got.pixels[3, 1, 1, 0] == 15.0
    np.testing.assert_allclose(got.velocity[3:5, 1], 25.0)
    assert len(got) == 4
    assert got.kept.tolist() == [0, 1, 2, 3]
    assert len(gathered([], np.arange(6), rate=25.0, camera_names=("a", "b"))) == 0


def test_arrays_that_do_not_belong_together_are_rejected():
    good = gathered([sightings(1, 2, [0])], np.arange(3), rate=25.0, camera_names=("a", "b")).arrays()
    for name, value in (("rate", 0.0), ("frames", [0, 1]), ("frames", [0, 2, 1]), ("removed", [True])):
        with pytest.raises(SettingProblem, match=r"are inconsistent"):
            Trajectories(**(good | {name: np.array(value)}))
