"""A step of one trial: what it leaves, when it is done again, and what its faults cost."""

import socket
from dataclasses import replace
from pathlib import Path

import pytest
from tests.studies import write_study

import marey
from marey.io.study.records import read_step_record, write_step_record
from marey.io.study.settings import read_study
from marey.io.study.trials import find_trials
from marey.pipelines.study.steps import StepTask, run_step
from marey.pipelines.study.study import _plan
from marey.pipelines.verdict import NotUsable, Verdict, VerdictReason


@pytest.fixture
def task(tmp_path) -> StepTask:
    folder = write_study(tmp_path / "gait", subjects=1)
    return task_of(folder)


def task_of(folder: Path) -> StepTask:
    settings = read_study(folder)
    (trial,) = find_trials(folder, settings, results=folder / "results")
    (task,) = _plan(folder, folder / "results", trial, settings).tasks
    return task


@pytest.mark.slow
def test_a_step_is_done_once_for_the_same_inputs_settings_and_version(task, monkeypatch):
    done = run_step(task)
    assert (done.state, done.trial, done.step, done.message) == ("done", "S01/slow_1", "markers", "")
    record = read_step_record(task.record)
    assert record is not None
    assert (record.verdict, record.report, record.host) == ("good", "report.html", socket.gethostname())
    assert len(record.values) == 18
    assert run_step(task).state == "reused"
    assert run_step(replace(task, settings={**task.settings, "side": "left"})).state == "done"
    assert run_step(task).state == "done"  # the results were those of other settings
    (Path(task.out) / "angles.csv").unlink()
    assert run_step(task).state == "done"
    monkeypatch.setattr(marey, "__version__", "9.9", raising=False)
    assert "has marey 9.9, and the study" in run_step(task).message
    assert run_step(replace(task, version="9.9")).state == "done"


def test_a_study_that_was_moved_is_still_done(task, tmp_path):
    assert run_step(task).state == "done"
    (tmp_path / "gait").rename(tmp_path / "elsewhere")
    assert run_step(task_of(tmp_path / "elsewhere")).state == "reused"


def test_a_damaged_trial_fails_and_is_tried_again(task):
    whole = Path(task.path).read_bytes()
    Path(task.path).write_bytes(whole[:700])
    failed = run_step(task)
    assert failed.state == "failed"
    assert "slow_1.c3d" in failed.message
    assert "\n" not in failed.message
    Path(task.path).write_bytes(whole)
    assert run_step(task).state == "done"


def test_an_error_of_the_program_costs_this_step_only_and_leaves_its_traceback(task, monkeypatch):
    def broken(*_: object) -> None:
        raise ZeroDivisionError("one over nothing")

    monkeypatch.setattr("marey.pipelines.study.steps.run_command", broken)
    assert run_step(task).message == "error of the program (ZeroDivisionError: one over nothing)"
    record = read_step_record(task.record)
    assert record is not None
    assert "in broken" in record.traceback


def test_the_answer_not_usable_is_an_answer_and_not_a_failure(task, monkeypatch):
    reason = VerdictReason.failure("The cameras contradict each other.")

    def answered(*_: object) -> None:
        raise NotUsable(Verdict.of([reason]))

    monkeypatch.setattr("marey.pipelines.study.steps.run_command", answered)
    assert run_step(task).state == "done"
    record = read_step_record(task.record)
    assert record is not None
    assert (record.verdict, record.reasons) == ("not usable", ("The cameras contradict each other.",))
    assert run_step(task).state == "reused"


def test_a_full_disk_is_named_and_the_same_step_then_succeeds(task, full_disk):
    with full_disk(5000):
        failed = run_step(task)
    assert failed.state == "failed"
    assert "cannot be written" in failed.message
    assert run_step(task).state == "done"


def test_a_step_that_was_cut_off_on_a_lost_computer_is_begun_again(task):
    done = run_step(task)
    before = read_step_record(task.record)
    assert before is not None
    write_step_record(task.record, replace(before, state="running", host="node07", process=41))
    work = Path(task.out) / ".work"
    work.mkdir()
    (work / "lock").write_text('{"process": 41, "host": "node07"}')
    again = run_step(task)
    assert (again.state, again.interruptions, done.interruptions) == ("done", 1, 0)
    # A lock of another process is not known to be lost.
    write_step_record(task.record, replace(before, state="running", host="node07", process=41))
    work.mkdir()
    (work / "lock").write_text('{"process": 42, "host": "node07"}')
    assert "is in use by another run of marey" in run_step(task).message
