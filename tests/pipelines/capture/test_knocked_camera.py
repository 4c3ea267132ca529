"""A capture with a knocked camera: it begins again with the camera in its new place; and the cameras' uncertainty."""

from dataclasses import replace

import numpy as np
import pytest
from tests import made_walk
from tests.fit.cameras.test_frontier import hulls_of, knocked
from tests.pipelines.capture.reach import copy_trial

from marey.cameras.parameters import PARAMETERS, pose_basis
from marey.fit.cameras.frontier import find_camera
from marey.io.trial.trial import read_trial
from marey.pipelines.cameras.knocked import CameraKnocked, KnockedCamera
from marey.pipelines.capture import capture
from marey.pipelines.capture.capture import capture_trial
from marey.pipelines.capture.run import Run
from marey.pipelines.capture.settings import CaptureSettings
from marey.pipelines.capture.tracked import camera_errors, report_found_camera
from marey.pipelines.progress import RecordingProgress


@pytest.fixture(scope="module")
def found():
    cameras = made_walk.cameras()
    again = find_camera(knocked(cameras, 1), hulls_of(cameras), 1)
    return KnockedCamera(number=1, found=again, contradiction_px=20.0)


@pytest.fixture
def runs(monkeypatch, found):
    """Records the runs of a capture, whose second camera is knocked when it checks the cameras; nothing is captured."""
    made = []

    def run_capture(run, bodies, logs):
        made.append(run)
        if run.checks_cameras and run.moved is None:
            raise CameraKnocked(run.trial.rig, found)

    monkeypatch.setattr(capture, "run_capture", run_capture)
    monkeypatch.setattr(capture, "load_motion", lambda folder: folder)
    return made


def test_the_second_run_has_the_camera_in_its_new_place(runs, found, tmp_path):
    trial = read_trial(copy_trial(tmp_path / "reach"), frames=(20, 60))
    progress = RecordingProgress()
    capture_trial(trial, CaptureSettings(out=tmp_path / "out"), progress)
    first, second = runs
    assert first.moved is None
    assert second.moved is trial.rig.cameras[1]
    assert second.repairs.moved is second.moved
    assert [reason.level for reason in second.repairs.reasons] == ["usable with limits"]
    assert second.trial.rig.cameras[0] is trial.rig.cameras[0]
    np.testing.assert_array_equal(second.trial.rig.cameras[1].centre, found.found.camera.centre)
    assert first.scope != second.scope


def test_the_cameras_are_not_checked_if_the_user_says_so(runs, tmp_path):
    settings = CaptureSettings(out=tmp_path / "out", check="off")
    capture_trial(read_trial(copy_trial(tmp_path / "reach"), check="off"), settings, RecordingProgress())
    [only] = runs
    assert not only.checks_cameras


@pytest.fixture
def run(tmp_path):
    trial = read_trial(copy_trial(tmp_path / "reach"))
    settings = CaptureSettings(out=tmp_path / "out")
    return Run(trial, settings, RecordingProgress(), None, None, tmp_path, moved=trial.rig.cameras[1])


def test_the_uncertainty_of_a_found_camera_replaces_that_of_its_calibration(run):
    count = PARAMETERS * len(run.trial.rig)
    stated, own = np.diag(np.full(count, 4.0)), np.zeros((count, count))
    own[24:30, 24:30] = 9.0 * np.eye(6)
    run = replace(run, trial=replace(run.trial, camera_covariance=stated))
    basis = camera_errors(run, own).basis
    expected = np.full(count, 4.0)
    expected[24:30] = 9.0
    np.testing.assert_allclose(np.diag(basis @ basis.T), expected)
    exact = replace(run, settings=replace(run.settings, camera_uncertainty=False))
    assert camera_errors(exact, own) is None
    assert camera_errors(replace(run, trial=replace(run.trial, camera_covariance=None)), None) is None


@pytest.mark.parametrize(("sd", "words"), [(1e-3, "better calibrate"), (0.05, "hardly determines it")])
def test_the_report_names_the_camera_and_how_well_it_is_known(run, sd, words):
    camera = run.trial.rig.cameras[1]
    covariance = np.zeros((PARAMETERS * len(run.trial.rig),) * 2)
    covariance[15:30, 15:30] = sd**2 * pose_basis(camera) @ pose_basis(camera).T
    report_found_camera(run, covariance)
    [warning] = run.progress.warnings
    assert warning.startswith("cam02 is not where the calibration places it")
    assert words in warning
