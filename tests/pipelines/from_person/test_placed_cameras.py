"""Cameras from the key points of a made walk: what is written, reported and refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
from tests.detected import openpose, write_folder
from tests.fit.cameras.test_from_joints import CAMERAS, NAMES, errors, sightings, unplaced, walker

from marey.cameras.rig import Rig
from marey.errors import FileProblem, SettingProblem
from marey.geometry.rigid import RigidTransform
from marey.io.calibration.covariance import read_camera_covariance
from marey.io.calibration.readers import read_rig, write_cameras_toml
from marey.io.trial.key_points import JOINTS
from marey.pipelines.from_person.placed_cameras import bone_lengths, calibrate_from_keypoints
from marey.pipelines.progress import RecordingProgress

FRAMES = 40


def write_made_trial(folder, *, unseen=()):
    """A trial with lenses that are 5 % wrong, and the key points of a made walk; there are no videos."""
    folder.mkdir()
    # A calibration states different places; they are ignored.
    places = [RigidTransform(np.eye(3), np.array([0.1 * c, 0.0, 0.0])) for c in range(len(CAMERAS))]
    pairs = zip(unplaced(1.05), places, strict=True)
    apart = [replace(camera, camera_from_world=place) for camera, place in pairs]
    write_cameras_toml(Rig(tuple(apart)), folder / "cameras.toml")
    pixels = np.full((FRAMES, len(CAMERAS), len(JOINTS), 2), np.nan)
    pixels[:, :, [JOINTS.index(name) for name in NAMES]] = sightings(walker(FRAMES)).pixels
    people = [
        [[] if camera.name in unseen else [openpose(own)] for camera, own in zip(CAMERAS, views, strict=True)]
        for views in pixels
    ]
    write_folder(folder / "detected", [camera.name for camera in CAMERAS], people)
    return folder


@pytest.fixture
def folder(tmp_path):
    return write_made_trial(tmp_path / "walk")


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """The calibration, the warnings of its run, and the folder of its results."""
    folder, progress = write_made_trial(tmp_path_factory.mktemp("placed") / "walk"), RecordingProgress()
    out = folder / "found"
    return calibrate_from_keypoints(folder, folder / "detected", out=out, progress=progress), progress.warnings, out


@pytest.mark.slow
def test_cameras_are_written_with_their_covariance(found):
    rig = read_rig(found[2] / "cameras.toml")
    turn, shift, _ = errors(rig.cameras)
    assert turn.max() < np.deg2rad(0.6)
    assert shift.max() < 0.05
    covariance = read_camera_covariance(found[2] / "cameras.toml", rig)
    np.testing.assert_allclose(covariance, found[0].covariance, atol=1e-12)
    assert found[0].usable


@pytest.mark.slow
def test_every_camera_has_a_line_and_its_focal_length(found):
    content = json.loads((found[2] / "calibration.json").read_text())
    assert content["source"] == "detected joints"
    assert len(found[0].lines) == 4
    for camera in CAMERAS:
        focal = content["cameras"][camera.name]["lens"]["fx"]
        assert abs(focal["value"] - camera.matrix[0, 0]) < 3 * focal["sd"] < 0.2 * focal["value"]


@pytest.mark.slow
def test_without_videos_the_reason_for_no_refinement_is_said(found):
    assert any("not refined by silhouettes" in warning for warning in found[1])


def test_a_camera_without_joints_is_named_and_nothing_is_written(tmp_path):
    folder, progress = write_made_trial(tmp_path / "walk", unseen=("cam02",)), RecordingProgress()
    (folder / "sync.json").write_text("{}")
    found = calibrate_from_keypoints(folder, folder / "detected", out=folder / "found", progress=progress)
    assert any("sync.json is not used" in warning for warning in progress.warnings)
    assert found.undetermined == ("cam02",)
    assert not found.usable
    assert not (folder / "found").exists()
    assert any("do not determine cam02" in warning for warning in progress.warnings)


def test_the_folder_of_the_calibration_is_not_overwritten(folder):
    with pytest.raises(FileProblem, match="is the folder of the trial"):
        calibrate_from_keypoints(folder, folder / "detected", out=folder)


def test_focal_lengths_need_videos(folder):
    with pytest.raises(FileProblem, match="has 0 videos"):
        calibrate_from_keypoints(folder, folder / "detected", out=folder / "found", focal=500.0)


def test_an_unknown_camera_is_named(folder):
    with pytest.raises(SettingProblem, match="cam09"):
        calibrate_from_keypoints(folder, folder / "detected", out=folder / "found", cameras=("cam01", "cam09"))


def test_a_known_stature_makes_the_scale_surer():
    unknown, tall = bone_lengths(), bone_lengths(1.9)
    assert np.all(tall.expected_m > unknown.expected_m)
    assert tall.scale_sd < unknown.scale_sd
