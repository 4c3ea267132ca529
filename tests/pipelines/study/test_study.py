"""A study on a local cluster of processes: results as one by one, killed workers, and an existing scheduler."""

import os
import signal
import threading
import time
import warnings
from pathlib import Path
from types import SimpleNamespace

import pytest
from tests.studies import write_study

import marey
from marey.errors import FileProblem, SettingProblem
from marey.io.study.records import read_step_record
from marey.io.study.tables import TrialRow
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.study import cluster
from marey.pipelines.study.cluster import SchedulerLost
from marey.pipelines.study.schedule import NOT_BEGUN, TrialPlan, run_plans
from marey.pipelines.study.steps import StepOutcome, StepTask
from marey.pipelines.study.study import STUDY_RESULTS, _verdict, run_study

distributed = pytest.importorskip("distributed", reason="studies need the packages of the extra `study`")


class _Future:
    """A future that is done at once, as that of a client of one worker."""

    def __init__(self, outcome: StepOutcome | BaseException):
        self._outcome = outcome

    def exception(self) -> BaseException | None:
        return self._outcome if isinstance(self._outcome, BaseException) else None

    def result(self) -> StepOutcome:
        assert isinstance(self._outcome, StepOutcome)
        return self._outcome

    def release(self) -> None:
        pass

    def cancel(self, *, force: bool) -> None:
        raise AssertionError("every step has ended")


class _Ended(list):
    """In place of `as_completed`."""

    def __init__(self, futures: list, *, loop: object):
        super().__init__(futures)

    add = list.append

    def __next__(self) -> _Future:
        return self.pop(0)


class _Client:
    """A client whose only worker runs steps in this process."""

    loop = None
    scheduler = SimpleNamespace(address="tcp://here:8786")

    def __init__(self, work):
        self.work, self.given = work, []

    def nthreads(self) -> dict[str, int]:
        return {"here": 1}

    def submit(self, run, task: StepTask, *, key: str, pure: bool) -> _Future:
        self.given.append(key)
        try:
            return _Future(self.work(task))
        except distributed.KilledWorker as error:
            return _Future(error)


def task(trial: str, step: str, folder: Path) -> StepTask:
    return StepTask(
        trial=trial, step=step, command="markers", path=str(folder), out=str(folder / trial / step), settings={},
        files={}, version="1",
    )  # fmt: skip


def test_steps_of_a_trial_follow_each_other_and_a_failure_costs_the_rest_of_its_trial_only(tmp_path, monkeypatch):
    def work(step: StepTask) -> StepOutcome:
        if (step.trial, step.step) == ("b", "first"):
            raise distributed.KilledWorker("b", "worker", 2)
        return StepOutcome(trial=step.trial, step=step.step, state="done")

    monkeypatch.setattr(distributed, "as_completed", _Ended)
    plans = [TrialPlan(trial=t, tasks=tuple(task(t, s, tmp_path) for s in ("first", "second"))) for t in "abc"]
    client, progress = _Client(work), RecordingProgress()
    found = run_plans(client, plans, progress, root=tmp_path)
    assert {key: outcome.state for key, outcome in found.items()} == {
        ("a", "first"): "done", ("a", "second"): "done", ("b", "first"): "failed", ("b", "second"): NOT_BEGUN,
        ("c", "first"): "done", ("c", "second"): "done",
    }  # fmt: skip
    assert client.given.index("a: first") < client.given.index("a: second")
    assert "b: second" not in client.given
    (warning,) = progress.warnings
    assert warning.startswith("b: the step first failed: 1 worker ended while it worked on it.")


@pytest.mark.parametrize(
    "loss", [distributed.client.FutureCancelledError("a: first", "scheduler-connection-lost"), OSError("closed")]
)
def test_a_scheduler_that_ends_is_named_with_its_address(tmp_path, monkeypatch, loss):
    def work(step: StepTask) -> StepOutcome:
        raise loss

    monkeypatch.setattr(distributed, "as_completed", _Ended)
    plans = [TrialPlan(trial="a", tasks=(task("a", "first", tmp_path),))]
    with pytest.raises(SchedulerLost, match=r"The scheduler at tcp://here:8786 has ended, .* it resumes"):
        run_plans(_Client(work), plans, RecordingProgress(), root=tmp_path)


def test_the_verdict_names_trials_without_results():
    def row(trial: str, **given: str) -> TrialRow:
        usual = {"state": "done", "verdict": "good", "reason": "", "subject": "", "condition": "", "step": "markers"}
        return TrialRow(trial=trial, report="", seconds=0.0, memory_mb=0.0, interruptions=0, **{**usual, **given})

    good = [row(f"t{k}") for k in range(8)]
    assert _verdict(good).level == "good"
    one = _verdict([*good, row("bad", state="failed", verdict="")])
    assert one.level == "usable with limits"
    assert "1 of 9 trials failed: bad." in str(one)
    only = [row("only", verdict="usable with limits")]
    assert "1 of 1 trial has results that are usable with limits: only." in str(_verdict(only))
    half = _verdict([*good[:2], *(row(f"x{k}", verdict="not usable") for k in range(3))])
    assert half.level == "not usable"


@pytest.mark.parametrize(
    ("given", "wrong"),
    [
        ({"workers": 0}, "workers (--workers) is 0"),
        ({"memory_gb": 0.01}, "memory (--memory) is 0.01 GB"),
        ({"scheduler": "tcp://127.0.0.1:1", "workers": 2}, "--scheduler has workers of its own"),
        ({"scheduler": "tcp://127.0.0.1:1"}, "No scheduler answers at tcp://127.0.0.1:1 (--scheduler)"),
        ({"scheduler": "nonsense://x"}, "No scheduler answers at nonsense://x"),
    ],
)
def test_impossible_workers_are_one_line_and_leave_nothing(tmp_path, monkeypatch, given, wrong):
    monkeypatch.setattr(cluster, "CONNECT_S", 0.5)
    folder = write_study(tmp_path / "gait")
    with pytest.raises(SettingProblem) as error:
        run_study(folder, progress=RecordingProgress(), **given)
    assert wrong in str(error.value)
    assert not (folder / "results").exists()


@pytest.mark.slow
def test_two_local_clusters_warn_of_nothing_and_serve_this_computer_only():
    given = {"workers": 1, "memory_gb": None, "progress": RecordingProgress()}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with cluster.opened_client(None, **given) as one, cluster.opened_client(None, **given) as other:
            servers = [client.cluster.scheduler.http_server for client in (one, other)]
            assert {server.address for server in servers} == {"127.0.0.1"}
            assert len({server.port for server in servers}) == 2
    assert [str(each.message) for each in caught if "Port" in str(each.message)] == []


def test_a_study_without_settings_is_named_before_anything_starts(tmp_path):
    with pytest.raises(FileProblem, match=r"study.toml: does not exist"):
        run_study(tmp_path)


@pytest.mark.slow
def test_a_study_has_the_figures_of_its_trials_alone_although_a_worker_is_killed(tmp_path):
    folder = write_study(tmp_path / "gait", subjects=3, conditions=("fast", "slow"))
    whole = (folder / "S03" / "slow_1.c3d").read_bytes()
    (folder / "S03" / "slow_1.c3d").write_bytes(whole[:600])
    killer = threading.Thread(target=kill_a_worker, args=(folder / "results",))
    killer.start()
    found = run_study(folder, workers=2, progress=RecordingProgress())
    killer.join()
    assert {(row.trial, row.state) for row in found.trials} == {
        (f"S{s:02d}/{c}_1", "failed" if (s, c) == (3, "slow") else "done") for s in (1, 2, 3) for c in ("fast", "slow")
    }  # fmt: skip
    assert sum(row.interruptions for row in found.trials) == 1
    assert {path.name for path in found.folder.iterdir() if path.is_file()} == {*STUDY_RESULTS, "run.json"}
    assert found.verdict.level == "usable with limits"
    reporter = RecordingProgress()
    for name in ("S01/fast_1", "S02/slow_1"):
        alone = marey.open_markers(folder / f"{name}.c3d", reference=folder / "frame0.npz", progress=reporter)
        marey.estimate_bones(alone, "rigid", out=tmp_path / name, progress=reporter)
        own = found.folder / name / "markers" / "angles.csv"
        assert own.read_bytes() == (tmp_path / name / "angles.csv").read_bytes()
    # An existing scheduler, here that of a local cluster, does only what is missing.
    (folder / "S03" / "slow_1.c3d").write_bytes(whole)
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as other:
        again = run_study(folder, scheduler=other.scheduler_address, progress=RecordingProgress())
    assert {row.state for row in again.trials} == {"done"}
    assert again.verdict.level == "good"
    assert {row.seconds for row in found.trials if row.state == "done"} < {row.seconds for row in again.trials}


def kill_a_worker(results: Path) -> None:
    """Kill the process of the first step that runs."""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        for path in results.glob("*/*/markers.json"):
            record = read_step_record(path)
            if record is not None and record.state == "running":
                os.kill(record.process, signal.SIGKILL)
                return
        time.sleep(0.002)
