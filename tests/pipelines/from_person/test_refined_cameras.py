"""Cameras refined by a person: what is written and reported; nothing is captured."""

import json
import re

import numpy as np
import pytest
from tests.pages import linked_files
from tests.pipelines.capture.reach import copy_trial
from tests.verdicts import agreed_verdict

from marey.cameras.parameters import PARAMETERS, pose_basis, stepped_camera
from marey.errors import FileProblem
from marey.fit.cameras.refine import RefinedCameras
from marey.io.calibration.covariance import read_camera_covariance
from marey.io.calibration.readers import read_rig
from marey.pipelines.capture.tracked import FollowedPerson, Tracked
from marey.pipelines.from_person import refined_cameras
from marey.pipelines.from_person.refined_cameras import calibrate_from_person
from marey.pipelines.progress import RecordingProgress

SHIFT_M, SD_M = 0.02, 0.003


@pytest.fixture
def folder(tmp_path):
    return copy_trial(tmp_path / "reach")


@pytest.fixture(params=[(), ("cam02",)], ids=["determined", "undetermined"])
def undetermined(request, monkeypatch):
    """The refinement shifts the second camera by 20 mm along X."""

    def followed(run, bodies, logs):
        return FollowedPerson(Tracked(bodies.fine, {}, {}), {}, None, ())

    def refined(take, body, poses, for_shape, settings, *, priors, height, progress):
        cameras, covariance = list(take.cameras), np.zeros((PARAMETERS * len(take.cameras),) * 2)
        basis = pose_basis(cameras[1])[:, 3:]
        cameras[1] = stepped_camera(cameras[1], basis[:, 0] * SHIFT_M)
        covariance[15:30, 15:30] = SD_M**2 * basis @ basis.T
        return RefinedCameras(
            cameras=tuple(cameras), covariance=covariance, poses=poses, body=body, undetermined=request.param, steps=()
        )

    monkeypatch.setattr(refined_cameras, "follow_person", followed)
    monkeypatch.setattr(FollowedPerson, "take", lambda self, run: CamerasAlone(run))
    monkeypatch.setattr(refined_cameras, "frames_for_sizes", lambda run, scores: [])
    monkeypatch.setattr(refined_cameras, "refine_cameras", refined)
    return request.param


class CamerasAlone:
    """The cameras of a run, without silhouettes."""

    def __init__(self, run):
        self.cameras = run.trial.rig.cameras


def test_cameras_and_their_covariance_are_written_together(folder, undetermined, tmp_path):
    progress, out = RecordingProgress(), tmp_path / "out"
    found = calibrate_from_person(folder, out=out, frames=(20, 60), progress=progress)
    before, after = read_rig(folder), read_rig(out / "cameras.toml")
    np.testing.assert_allclose(after["cam02"].centre - before["cam02"].centre, [SHIFT_M, 0, 0], atol=1e-12)
    np.testing.assert_allclose(after["cam01"].centre, before["cam01"].centre, atol=1e-12)
    np.testing.assert_array_equal(read_camera_covariance(out / "cameras.toml", after), found.covariance)
    assert found.lines[1].startswith("cam02: turned by 0.00 degrees (sd 0.00), shifted by 20 mm (sd 5)")
    assert found.usable == (not undetermined)
    assert found.report == out / "calibration.html"
    assert agreed_verdict(out / "run.json", page=found.report) == found.verdict
    page = found.report.read_text()
    use = re.search(r"cameras to use</\w+>\s*<\w+ class=\"value\">new<", page)
    assert bool(use) == (not undetermined)
    known = "no" if undetermined else "yes"
    assert re.search(rf"<th>cam02</th><td>0.00</td><td>0.00</td><td>20</td><td>5</td>.*>{known}<", page)
    assert linked_files(found.report) == ["cameras.toml", "calibration.json", "run.json"]
    assert found.verdict.level == ("not usable" if undetermined else "good")
    findings = json.loads((out / "calibration.json").read_text())["findings"]
    assert [each["code"] for each in findings] == ["undetermined" if undetermined else "use-new-cameras"]
    assert len(progress.warnings) == len(undetermined)
    if not undetermined:
        assert found.lines[-1].endswith("most cam02. Use the new cameras.")
    settings = json.loads((out / "run.json").read_text())["settings"]
    assert settings["from_person"] is True
    assert settings["frames"] == [20, 60]


def test_the_cameras_of_the_trial_are_not_overwritten(folder, undetermined):
    with pytest.raises(FileProblem, match="is the folder of the trial's cameras"):
        calibrate_from_person(folder, out=folder, progress=RecordingProgress())
    assert not (folder / "calibration.json").exists()
