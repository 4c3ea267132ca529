import numpy as np

from marey.pipelines.speed import speeds as bench


def test_both_solvers_find_the_same_pose_which_is_the_true_one(rng):
    task = bench.solve_task(rng)
    ours, theirs = task.solve(), task.peer()
    np.testing.assert_allclose(ours.angles, theirs.angles, atol=1e-5)
    np.testing.assert_allclose(ours.translation, task.truth.translation, atol=2e-3)


def test_the_table_names_the_machine_and_every_speed(capsys, monkeypatch):
    monkeypatch.setattr(bench, "median_ms", lambda work, *, repeats: 2.0)
    speeds = bench.bench(None)
    shown = " ".join(capsys.readouterr().out.split())
    assert "cores" in shown
    assert len(speeds) == 4
    assert "2.00 ms" in shown
