"""A capture of cameras that were not started together: it begins again with their clocks."""

import numpy as np
import pytest
from tests import made_walk
from tests.pipelines.capture.reach import copy_trial

from marey.io.trial.trial import read_trial
from marey.pipelines.capture import capture
from marey.pipelines.capture.capture import capture_trial
from marey.pipelines.capture.settings import CaptureSettings
from marey.pipelines.clocks.disagreement import ClocksDisagree
from marey.pipelines.progress import RecordingProgress

CLOCKS = made_walk.clocks([0, 0, -3.0, 0.4])


@pytest.fixture
def runs(monkeypatch):
    """Records the runs of a capture, whose silhouettes show the clocks when it checks them; nothing is captured."""
    made = []

    def run_capture(run, bodies, logs):
        made.append(run)
        if run.checks_clocks:
            raise ClocksDisagree(CLOCKS, 30.0)

    monkeypatch.setattr(capture, "run_capture", run_capture)
    monkeypatch.setattr(capture, "load_motion", lambda folder: folder)
    return made


@pytest.mark.slow
def test_the_second_run_has_the_clocks_that_the_first_one_found(runs, tmp_path):
    trial = read_trial(copy_trial(tmp_path / "reach"), frames=(20, 100))
    progress = RecordingProgress()
    capture_trial(trial, CaptureSettings(out=tmp_path / "out"), progress)
    first, second = runs
    assert first.times is None
    assert first.trial is trial
    assert second.trial.clocks is CLOCKS
    assert not second.checks_clocks
    assert (second.trial.take.first, second.trial.take.end) == (20, 100)
    np.testing.assert_allclose(second.times.late[3, 20:100], 0.4, atol=1e-9)
    assert second.trial.take.common.pictures[2, 20] == 23
    [warning] = [text for text in progress.warnings if "not started together" in text]
    assert "cam03 0.100 s (3.00 frames) earlier, cam04 0.013 s (0.40 frames) later than cam01" in warning


@pytest.mark.parametrize("sync", ["off", "file"])
def test_the_clocks_are_not_checked_if_the_user_has_decided(runs, tmp_path, sync):
    settings = CaptureSettings(out=tmp_path / "out", sync=sync)
    trial = read_trial(copy_trial(tmp_path / "reach"), **settings.changes())
    capture_trial(trial, settings, RecordingProgress())
    [only] = runs
    assert not only.checks_clocks
    assert only.times is None
