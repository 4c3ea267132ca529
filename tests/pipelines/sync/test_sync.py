"""Clocks of a made trial: found, written, and used by the next reader of the trial; and what cannot be used."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests import made_walk
from tests.verdicts import agreed_verdict

from marey.cameras.rig import Rig
from marey.cli.main import run
from marey.errors import FileProblem
from marey.io.calibration.readers import write_cameras_toml
from marey.io.trial.masks import write_masks
from marey.io.trial.trial import read_trial
from marey.io.video.sound import SOUND_RATE, Sound
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.sync import measurements
from marey.pipelines.sync.tasks import synchronise
from marey.pipelines.verdict import Verdict

OFFSETS = [0.0, 0.4, -3.0]
FRAMES = [90, 90, 84]


def make_trial(folder: Path, *, still: bool = False, flash_s: float | None = None) -> Path:
    """Three cameras with given silhouettes; their videos show nothing but a flash, if there is one."""
    (folder / "masks").mkdir(parents=True)
    cameras = made_walk.cameras(3)
    write_cameras_toml(Rig(tuple(cameras)), folder / "cameras.toml")
    masks = made_walk.silhouettes(cameras, made_walk.clocks(OFFSETS), frames=FRAMES, still=still)
    for camera, own, offset in zip(cameras, masks, OFFSETS, strict=True):
        write_masks(folder / "masks" / f"{camera.name}.npz", own, shape=(len(own), camera.height, camera.width))
        video = cv2.VideoWriter(
            str(folder / f"{camera.name}.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), made_walk.RATE, camera.size
        )
        lit = -1 if flash_s is None else round(flash_s * made_walk.RATE - offset)
        for f in range(len(own)):
            video.write(np.full((camera.height, camera.width, 3), 180 if f == lit else 60, np.uint8))
        video.release()
    return folder


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    return make_trial(tmp_path_factory.mktemp("sync") / "trial")


@pytest.fixture(scope="module")
def moveless(tmp_path_factory):
    return make_trial(tmp_path_factory.mktemp("sync") / "still", still=True)


@pytest.mark.slow
def test_the_clocks_are_written_where_the_trial_finds_them(trial):
    progress = RecordingProgress()
    found = synchronise(trial, progress=progress)
    written = json.loads((trial / "sync.json").read_text())
    np.testing.assert_allclose(found.clocks.offset_s * made_walk.RATE, OFFSETS, atol=0.12)
    assert [*written["cameras"]] == ["cam01", "cam02", "cam03"]
    assert written["cameras"]["cam01"] == {"offset_s": 0, "offset_sd_s": 0, "drift_ppm": 0, "drift_sd_ppm": 0}
    assert written["cameras"]["cam02"]["offset_s"] == pytest.approx(found.clocks.offset_s[1], abs=1e-6)
    assert written["rates"]["cam02"] == made_walk.RATE
    assert written["sources"]["silhouettes"]["residual_px"] > 0
    assert str(found).splitlines()[1].startswith("cam02: +1")
    assert {"Silhouettes", "Clocks"} <= set(progress.timings)
    again = read_trial(trial)
    assert again.clocks is not None
    assert again.take.common is not None
    assert again.take.common.pictures[2, 10] == 13
    # The given silhouettes are those of the selected pictures.
    masks = made_walk.silhouettes(made_walk.cameras(3), made_walk.clocks(OFFSETS), frames=FRAMES)
    np.testing.assert_array_equal(next(again.masks["cam03"].masks([10])), masks[2][13])
    assert again.masks["cam03"].shape[0] == again.take.count


@pytest.mark.slow
def test_without_motion_nothing_is_written(moveless, tmp_path):
    with pytest.raises(FileProblem, match="does not determine the clocks: of cam02, "):
        synchronise(moveless, out=tmp_path / "clocks.json")
    assert not (tmp_path / "clocks.json").exists()


def test_the_command_prints_the_clocks_and_their_file(trial, tmp_path, capsys):
    out = tmp_path / "clocks.json"
    assert run(["sync", str(trial), "--out", str(out), "--cameras", "cam01,cam02", "--quiet"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "cam01: the clock to which the others are compared"
    assert lines[1].startswith("cam02: +1")
    assert lines[-1] == f"Clocks: {out}"
    assert agreed_verdict(out, printed="\n".join(lines)) == Verdict()
    assert set(json.loads(out.read_text())["cameras"]) == {"cam01", "cam02"}


@pytest.mark.parametrize(
    ("more", "line"),
    [
        ([], "does not determine the clocks"),
        (["--cameras", "cam01"], "has only the camera 'cam01'"),
        (["--cameras", "cam07"], "has no camera 'cam07'"),
        (["--keypoints", "nowhere"], "nowhere: does not exist. Correct keypoints"),
    ],
)
def test_what_cannot_be_used_is_one_line_and_code_two(moveless, capsys, more, line):
    assert run(["sync", str(moveless), "--quiet", *more]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert line in captured.err.splitlines()[-1]
    assert len([text for text in captured.err.splitlines() if text.startswith("marey:")]) == 1
    assert not (moveless / "sync.json").exists()


@pytest.mark.slow
def test_a_flash_determines_the_clocks_of_a_person_who_does_not_move(tmp_path):
    found = synchronise(make_trial(tmp_path / "lit", still=True, flash_s=1.2), progress=RecordingProgress())
    assert found.undetermined == {}
    assert (np.abs(found.clocks.offset_s * made_walk.RATE - OFFSETS) <= 0.5).all()
    assert (found.clocks.offset_sd_s[1:] * made_walk.RATE > 0.35).all()
    assert set(found.sources) == {"silhouettes", "light"}


def clapped(offset_s: float, rng: np.random.Generator) -> Sound:
    """Three claps, as a camera with an offset records them."""
    samples = 0.003 * rng.normal(size=SOUND_RATE * 3)
    for instant in (0.8, 1.1, 2.0):
        first = round((instant - offset_s) * SOUND_RATE)
        samples[first : first + 800] += 0.5 * rng.normal(size=800) * np.exp(-np.arange(800) / 150)
    return Sound(samples=samples, begin_s=0.0)


def test_claps_determine_the_clocks_of_a_person_who_does_not_move(moveless, tmp_path, rng, monkeypatch):
    heard = {"cam01": clapped(0.0, rng), "cam02": clapped(0.35, rng), "cam03": None}
    monkeypatch.setattr(measurements, "read_sound", lambda path: heard[path.stem])
    found = synchronise(moveless, out=tmp_path / "clocks.json", progress=RecordingProgress())
    assert found.clocks.names == ("cam01", "cam02")
    assert found.clocks.offset_s[1] == pytest.approx(0.35, abs=0.003)
    assert "it recorded no sound" in found.undetermined["cam03"]
    assert set(json.loads((tmp_path / "clocks.json").read_text())["sources"]) == {"silhouettes", "sound"}


@pytest.mark.slow
def test_sound_that_contradicts_the_pictures_is_named(trial, tmp_path, rng, monkeypatch):
    heard = {"cam01": clapped(0.0, rng), "cam02": clapped(0.3, rng), "cam03": None}
    monkeypatch.setattr(measurements, "read_sound", lambda path: heard[path.stem])
    progress = RecordingProgress()
    verdict = synchronise(trial, out=tmp_path / "clocks.json", progress=progress).verdict
    assert agreed_verdict(tmp_path / "clocks.json") == verdict
    assert verdict.level == "usable with limits"
    assert verdict.reasons[0].cameras == ("cam02",)
    [warning] = [text for text in progress.warnings if "sound of cam02" in text]
    assert "ms earlier than its pictures" in warning or "ms later than its pictures" in warning
