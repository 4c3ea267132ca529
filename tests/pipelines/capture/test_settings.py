from pathlib import Path

import pytest

from marey.errors import FileProblem
from marey.io.trial.settings import read_settings
from marey.pipelines.capture.settings import CaptureSettings


def test_an_option_wins_over_the_trials_own_file_and_none_leaves_it(tmp_path):
    (tmp_path / "trial.toml").write_text('stature_m = 1.7\npreset = "upper"\ncameras = ["a", "b"]\n')
    settings = CaptureSettings(preset="full", frames=(3, 9), leg_length_m=0.9, asis_distance_m=0.24)
    merged = read_settings(tmp_path, **settings.changes())
    assert (merged.preset, merged.stature_m, merged.cameras, merged.frames) == ("full", 1.7, ("a", "b"), (3, 9))
    assert (merged.leg_length_m, merged.asis_distance_m) == (0.9, 0.24)


def test_a_start_file_given_as_an_option_is_relative_to_the_current_folder(tmp_path, monkeypatch):
    (tmp_path / "clicks.json").write_text("{}")
    monkeypatch.chdir(tmp_path)
    changes = CaptureSettings(start=Path("clicks.json")).changes()
    assert changes["start"] == {"file": str(tmp_path / "clicks.json")}


def test_a_named_file_that_is_not_there_is_an_error_that_names_the_option():
    with pytest.raises(FileProblem, match=r"scan\.glb: does not exist\. Correct body \(--body\)"):
        CaptureSettings(body=Path("scan.glb"))


def test_a_generic_body_is_named_by_a_word_instead_of_a_file(tmp_path):
    assert CaptureSettings(body="metaballs").body_file is None
    with pytest.raises(FileProblem, match=r"balls: does not exist\..*It may also be metaballs or simple-metaballs"):
        CaptureSettings(body="balls")
    (tmp_path / "body.npz").touch()
    assert CaptureSettings(body=str(tmp_path / "body.npz")).body_file == tmp_path / "body.npz"


def test_the_folder_of_key_points_given_as_an_option_is_relative_to_the_current_folder(tmp_path, monkeypatch):
    (tmp_path / "pose").mkdir()
    monkeypatch.chdir(tmp_path)
    changes = CaptureSettings(keypoints=Path("pose")).changes()
    assert changes["keypoints"] == {"folder": str(tmp_path / "pose")}
    assert CaptureSettings().changes()["keypoints"] is None
    with pytest.raises(FileProblem, match=r"poses: does not exist\. Correct keypoints \(--keypoints\)\."):
        CaptureSettings(keypoints=Path("poses"))


def test_a_network_given_as_an_option_is_relative_to_the_current_folder(tmp_path, monkeypatch):
    (tmp_path / "net.onnx").touch()
    monkeypatch.chdir(tmp_path)
    changes = CaptureSettings(person_net=Path("net.onnx")).changes()
    assert changes["masks"] == {"network": str(tmp_path / "net.onnx")}
    with pytest.raises(FileProblem, match=r"none\.onnx: does not exist\. Correct person-net \(--person-net\)"):
        CaptureSettings(person_net=Path("none.onnx"))
