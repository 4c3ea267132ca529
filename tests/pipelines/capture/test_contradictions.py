"""A capture of cameras that contradict each other: it begins again with the repair, or ends with the cause."""

import json
from dataclasses import replace

import numpy as np
import pytest
from tests.pipelines.capture.reach import copy_trial

from marey.io.trial.trial import read_trial
from marey.pipelines.capture import capture
from marey.pipelines.capture.capture import MOST_REPAIRS, capture_trial
from marey.pipelines.capture.settings import CaptureSettings
from marey.pipelines.consistency.repairs import CamerasContradict, Repairs
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.verdict import NotUsable, Verdict, VerdictReason

MOVED = VerdictReason(level="usable with limits", what="cam03 was <moved>.", remedy="Calibrate it.", cameras=("cam03",))
EQUAL = VerdictReason(level="not usable", what="All calibrations are equal.")


@pytest.fixture
def trial(tmp_path):
    return read_trial(copy_trial(tmp_path / "reach"), frames=(20, 100))


@pytest.fixture
def runs(monkeypatch):
    """Returns a function that states what each run raises in turn; the runs are recorded, and nothing is captured."""
    made = []

    def begin(*problems):
        waiting = list(problems)

        def run_capture(run, bodies, logs):
            made.append(run)
            if waiting and run.checks_cameras:
                raise waiting.pop(0)

        monkeypatch.setattr(capture, "run_capture", run_capture)
        monkeypatch.setattr(capture, "load_motion", lambda folder: folder)
        return made

    return begin


def test_the_second_run_is_without_the_camera_that_contradicts(runs, trial, tmp_path):
    made = runs(CamerasContradict(Repairs(left_out=("cam03",), reasons=(MOVED,))))
    progress = RecordingProgress()
    capture_trial(trial, CaptureSettings(out=tmp_path / "out"), progress)
    first, second = made
    assert first.trial is trial
    assert second.trial.rig.names == ("cam01", "cam02", "cam04")
    assert (second.trial.take.first, second.trial.take.end) == (20, 100)
    assert second.repairs.reasons == (MOVED,)
    assert str(MOVED) in progress.warnings


def test_the_second_run_has_the_calibrations_that_belong_to_the_pictures(runs, trial, tmp_path):
    one, two = (trial.rig[name] for name in ("cam01", "cam02"))
    changed = {"cam01": replace(two, name="cam01"), "cam02": replace(one, name="cam02")}
    made = runs(CamerasContradict(Repairs(cameras=changed, reasons=(MOVED,))))
    capture_trial(trial, CaptureSettings(out=tmp_path / "out"), RecordingProgress())
    np.testing.assert_array_equal(made[1].trial.rig["cam01"].centre, two.centre)
    assert made[1].trial.rig.names == trial.rig.names
    assert made[1].trial.take.names == trial.take.names


def test_the_user_can_avoid_the_check(runs, tmp_path):
    made = runs(CamerasContradict(Repairs(left_out=("cam03",), reasons=(MOVED,))))
    settings = CaptureSettings(out=tmp_path / "out", check="off")
    capture_trial(read_trial(copy_trial(tmp_path / "reach"), **settings.changes()), settings, RecordingProgress())
    [only] = made
    assert not only.checks_cameras


def test_repairs_come_to_an_end(runs, trial, tmp_path):
    again = [CamerasContradict(Repairs(cameras={"cam01": trial.rig["cam01"]}, reasons=(MOVED,)))] * (MOST_REPAIRS + 3)
    made = runs(*again)
    capture_trial(trial, CaptureSettings(out=tmp_path / "out"), RecordingProgress())
    assert len(made) == MOST_REPAIRS + 1


def test_a_run_without_a_usable_answer_leaves_its_verdict(runs, trial, tmp_path):
    runs(
        CamerasContradict(Repairs(left_out=("cam03",), reasons=(MOVED,))), NotUsable(Verdict.of([EQUAL]))
    )  # fmt: skip
    out = tmp_path / "out"
    with pytest.raises(NotUsable) as caught:
        capture_trial(trial, CaptureSettings(out=out), RecordingProgress())
    verdict = caught.value.verdict
    assert verdict.reasons == (EQUAL, MOVED)
    assert str(caught.value).splitlines()[-1] == f"Report: {out / 'report.html'}"
    record = json.loads((out / "run.json").read_text(encoding="utf-8"))
    assert Verdict.from_record(record) == verdict
    assert sorted(record["files"]) == ["report.html", "run.json"]
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "Verdict: not usable" in page
    assert "cam03 was &lt;moved&gt;. Calibrate it." in page
