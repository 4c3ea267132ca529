"""`marey markers`: options, printed text and exit codes."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.trials import marker_points, write_reference, write_trial
from tests.verdicts import agreed_verdict

from marey.cli.main import INTERRUPTED, WRONG_INPUT, run
from marey.markers.data.marker_set_tables import MARKER_SETS
from marey.markers.methods.methods import DEFAULT_METHOD
from marey.pipelines.labelled import Summary
from marey.pipelines.verdict import Verdict


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_trial(tmp_path / "walk.c3d", marker_points(), force=True)
    write_reference(tmp_path / "frame0.npz")
    return tmp_path


def test_a_trial_is_estimated_and_the_path_of_the_report_is_printed(folder, capsys):
    assert run(["markers", "walk.c3d", "--reference", "frame0.npz", "--method", "rigid,pct"]) == 0
    printed = capsys.readouterr()
    assert printed.out.endswith("\nReport: walk_marey/report.html\n")
    results = folder / "walk_marey"
    assert agreed_verdict(results / "run.json", printed=printed.out, page=results / "report.html") == Verdict()
    assert "thigh: 120 of 120 frames" in printed.err
    assert "methods: rigid, pct; the values are those of rigid" in printed.err
    assert (folder / "walk_marey" / "report.html").is_file()


def test_the_help_names_the_default_method(capsys):
    assert run(["markers", "--help"]) == 0
    assert f"[default: {DEFAULT_METHOD}]" in " ".join(capsys.readouterr().out.replace("│", " ").split())


@pytest.mark.parametrize(
    ("arguments", "wrong"),
    [
        (["nothing.c3d"], "nothing.c3d: does not exist"),
        (["walk.c3d", "--method", "magic"], "There is no method magic"),
        (["walk.c3d", "--reference", "nothing.npz"], "nothing.npz: does not exist. Correct reference (--reference)."),
        (["walk.c3d", "--frames", "500:600"], "(--frames) begins at 500"),
        (["walk.c3d", "--frames", "20:10"], "--frames"),
    ],
)
def test_wrong_input_is_one_clear_line_and_leaves_nothing(folder, capsys, arguments, wrong):
    assert run(["markers", *arguments]) == WRONG_INPUT
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("marey:")]
    assert wrong in line
    assert not list(folder.glob("*_marey"))


def test_a_reference_of_an_unknown_side_is_refused(folder, capsys):
    with np.load(folder / "frame0.npz") as file:
        np.savez(folder / "frame0.npz", **{**file, "side": "middle"})
    assert run(["markers", "walk.c3d", "--reference", "frame0.npz", "-q"]) == WRONG_INPUT
    assert "frame0.npz: has the side 'middle'. It should be left or right." in capsys.readouterr().err


def test_ctrl_c_has_its_own_exit_code(folder, monkeypatch):
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("marey.pipelines.markers.bones.write_results", interrupted)
    assert run(["markers", "walk.c3d", "--reference", "frame0.npz", "--method", "rigid", "-q"]) == INTERRUPTED


def test_all_options_reach_the_pipeline(tmp_path, monkeypatch):
    opened: dict[str, Any] = {}
    estimated: dict[str, Any] = {}

    def open_markers(trial: Path, **options: Any) -> str:
        opened.update(options, trial=trial)
        return "the trial"

    def estimate_bones(trial: str, method: Any, **options: Any) -> SimpleNamespace:
        estimated.update(options, trial=trial, method=method)
        return SimpleNamespace(summary=lambda: Summary("", {}), verdict=None)

    monkeypatch.setattr("marey.pipelines.markers.estimate.open_markers", open_markers)
    monkeypatch.setattr("marey.pipelines.markers.estimate.estimate_bones", estimate_bones)
    words = ["markers", "walk.c3d", "--reference", "r.npz", "--clusters", "c.toml", "--static", "s.c3d"]
    words += ["--functional", "f.c3d", "--functional", "g.c3d", "--exercise", "e.c3d", "--exercise-reference", "x.npz"]
    words += ["--method", "rigid,pct", "--model", "m.osim", "--weights", "w.xml", "--frames", ":90", "--fill", "best"]
    words += ["--person", "Ann", "--measurements", "knee_width_mm=99, left_ankle_width_mm=65.5"]
    words += ["--unit", "cm", "--side", "left", "--marker-set", "pig-full", "--out", str(tmp_path / "out"), "--quiet"]
    assert run(words) == 0
    del opened["progress"], estimated["progress"]
    assert opened == {
        "trial": Path("walk.c3d"), "reference": Path("r.npz"), "clusters": Path("c.toml"), "static": Path("s.c3d"),
        "functional": [Path("f.c3d"), Path("g.c3d")], "exercise": Path("e.c3d"), "exercise_reference": Path("x.npz"),
        "model": Path("m.osim"), "weights": Path("w.xml"), "frames": (0, 90), "fill": "best", "unit": "cm",
        "side": "left", "marker_set": "pig-full", "out": tmp_path / "out",
        "person": "Ann", "measurements": {"knee_width_mm": 99.0, "left_ankle_width_mm": 65.5},
    }  # fmt: skip
    assert estimated == {"trial": "the trial", "method": ("rigid", "pct"), "out": tmp_path / "out"}


def test_the_help_names_every_marker_set(capsys):
    assert run(["markers", "--help"]) == 0
    words = capsys.readouterr().out.replace(",", " ").split()
    assert {each.key for each in MARKER_SETS} <= {word.strip("│|.") for word in words}
