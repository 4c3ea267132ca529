import numpy as np

from marey.pipelines.progress import RecordingProgress
from marey.pipelines.speed import speeds as bench


def test_both_solvers_find_the_same_pose_which_is_the_true_one(rng):
    task = bench.solve_task(rng)
    ours, theirs = task.solve(), task.peer()
    np.testing.assert_allclose(ours.angles, theirs.angles, atol=1e-5)
    np.testing.assert_allclose(ours.translation, task.truth.translation, atol=2e-3)


def test_every_speed_is_measured_beside_a_limit_or_a_peer(monkeypatch):
    monkeypatch.setattr(bench, "median_ms", lambda work, *, repeats: 2.0)
    speeds = bench.measure_speeds(None, progress=RecordingProgress())
    assert len(speeds) == 4
    assert speeds[0].measured == "2.00 ms"
    assert "cores" in bench.machine()
