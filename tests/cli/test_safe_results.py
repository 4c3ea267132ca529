"""Results of commands never replace or mix with a user's files; nothing leaves the computer."""

import json
import os
import shutil
import socket
from pathlib import Path

import numpy as np
import pytest
from tests.clips import make_trial
from tests.trials import marker_points, write_reference, write_trial

from marey.cli.main import WRONG_INPUT, run
from marey.io.opensim.mot_sto import TimeSeriesTable, write_table
from marey.io.trial.masks import write_masks
from marey.io.work_folder import WorkFolder

TIME = np.arange(0, 4, 0.01)


def refused(arguments: list[str], folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Run a command that must fail in one line and change nothing in the folder; return the line."""
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert run(arguments) == WRONG_INPUT
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("marey:")]
    return line


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with inputs of several commands."""
    monkeypatch.chdir(tmp_path)
    knee = 35 - 30 * np.cos(5 * TIME) + 5 * np.sin(11 * TIME) + 3 * TIME
    for name in ("a", "b"):
        table = TimeSeriesTable(name=name, columns=("right_knee_flexion",), time=TIME, values=knee[:, None])
        write_table(tmp_path / f"{name}.mot", table)
    write_trial(tmp_path / "walk.c3d", marker_points(), force=True)
    write_reference(tmp_path / "frame0.npz")
    np.savez(tmp_path / "points.npz", points=np.random.default_rng(3).normal(size=(9, 3, 7)))
    return tmp_path


@pytest.mark.parametrize("command", ["capture", "surface", "shape", "capture --people all", "capture --list-people"])
def test_the_trial_is_not_a_folder_for_results(command, tmp_path, capsys):
    trial = make_trial(tmp_path, names=("cam01", "cam02", "cam03"))
    (trial / "background").mkdir()
    for camera in ("cam01", "cam02", "cam03"):
        shutil.copy(trial / f"{camera}.mp4", trial / "background" / f"{camera}.mp4")
    name, *options = command.split()
    line = refused([name, str(trial), "--out", str(trial), *options, "-q"], trial, capsys)
    assert f"{trial}: is an input of this run" in line
    assert "Give another folder for the results (--out)." in line


@pytest.mark.parametrize(
    "arguments",
    [
        ["compare", "a.mot", "b.mot"],
        ["markers", "walk.c3d", "--reference", "frame0.npz", "--method", "rigid"],
        ["nonrigid", "points.npz"],
    ],
    ids=lambda arguments: arguments[0],
)
def test_a_folder_with_inputs_is_not_a_folder_for_results(arguments, folder, capsys):
    line = refused([*arguments, "--out", ".", "-q"], folder, capsys)
    assert "contains inputs of this run" in line


def test_a_comparison_leaves_files_of_the_user_alone(folder, capsys):
    out = folder / "out"
    (out / ".work" / "results").mkdir(parents=True)
    (out / ".work" / "results" / "mine.txt").write_text("mine")
    line = refused(["compare", "a.mot", "b.mot", "--out", "out", "-q"], folder, capsys)
    assert "out/.work: holds files that are not checkpoints" in line
    shutil.rmtree(out / ".work")
    (out / "report.html").write_text("mine")
    line = refused(["compare", "a.mot", "b.mot", "--out", "out", "-q"], folder, capsys)
    assert "out/report.html: cannot be written (marey did not write what has this name). Rename it" in line
    (out / "report.html").rename(out / "other.html")
    for _ in range(2):
        assert run(["compare", "a.mot", "b.mot", "--out", "out", "-q"]) == 0
    assert (out / "other.html").read_text() == "mine"
    assert not (out / ".work").exists()


def test_clocks_replace_only_clocks(tmp_path, capsys):
    trial = make_trial(tmp_path)
    line = refused(["sync", str(trial), "--out", str(trial / "cameras.toml"), "-q"], trial, capsys)
    assert "cameras.toml: exists, and does not hold clocks of cameras. Give another name (--out)." in line


def test_silhouettes_among_results_are_not_known_silhouettes(tmp_path, capsys):
    trial = make_trial(tmp_path)
    for camera in ("cam01", "cam02"):
        write_masks(trial / "masks" / f"{camera}.npz", [np.ones((48, 64), bool)] * 12, shape=(12, 48, 64))
    (trial / "run.json").write_text(json.dumps({"command": "capture", "files": ["masks/cam01.npz", "run.json"]}))
    line = refused(["capture", str(trial), "--out", str(tmp_path / "out"), "-q"], tmp_path, capsys)
    assert "masks/cam01.npz: is a result of `marey capture`" in line


def test_a_body_in_the_folder_of_the_results_is_not_replaced(tmp_path, capsys):
    trial, out = make_trial(tmp_path), tmp_path / "out"
    out.mkdir()
    (out / "body.npz").write_text("a body")
    line = refused(["capture", str(trial), "--body", str(out / "body.npz"), "--out", str(out), "-q"], tmp_path, capsys)
    assert "body.npz: is in the folder of the results" in line


@pytest.mark.parametrize(
    "arguments",
    [
        ["compare", "a.mot", "b.mot"],
        ["markers", "walk.c3d", "--reference", "frame0.npz", "--method", "rigid"],
        ["nonrigid", "points.npz"],
    ],
    ids=lambda arguments: arguments[0],
)
def test_two_runs_do_not_share_a_folder(arguments, folder, capsys, monkeypatch):
    work = WorkFolder(folder / "out")
    monkeypatch.setattr("marey.io.work_folder._HELD", {})
    monkeypatch.setattr("marey.io.work_folder.lock_byte", lambda file, place: False)
    line = refused([*arguments, "--out", "out", "-q"], folder, capsys)
    assert f"out: is in use by another run of marey (process {os.getpid()}, on {socket.gethostname()}, since" in line
    monkeypatch.undo()
    work.close()


def test_nothing_needs_a_network(folder, monkeypatch):
    def denied(*_: object, **__: object) -> None:
        raise AssertionError("a socket was opened")

    for name in ("socket", "create_connection", "getaddrinfo"):
        monkeypatch.setattr(socket, name, denied)
    assert run(["compare", "a.mot", "b.mot", "--out", "compared", "-q"]) == 0
    assert run(["markers", "walk.c3d", "--reference", "frame0.npz", "--method", "rigid", "--out", "m", "-q"]) == 0
    assert run(["nonrigid", "points.npz", "--out", "n", "-q"]) in (0, WRONG_INPUT)
