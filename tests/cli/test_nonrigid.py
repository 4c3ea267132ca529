"""`marey nonrigid`: options, printed text and exit codes."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.verdicts import agreed_verdict

from marey.cli.main import INTERRUPTED, WRONG_INPUT, run
from marey.geometry import rotations
from marey.pipelines.labelled import Summary


@pytest.fixture
def points(tmp_path: Path) -> Path:
    """Points in space (F, 3, P) that rotate and deform in one way."""
    rng, time = np.random.default_rng(3), np.arange(40)
    path = rotations.exp(np.outer(0.08 * time, [0.1, 1.0, 0.0]))
    mean, mode = 100 * rng.normal(size=(2, 3, 9))
    np.savez(tmp_path / "cluster.npz", points=path @ (mean + 0.3 * np.sin(time / 7)[:, None, None] * mode))
    return tmp_path / "cluster.npz"


def test_points_are_factorised_and_the_report_can_be_viewed(points, capsys):
    assert run(["nonrigid", str(points), "--basis-shapes", "2"]) == 0
    out = points.with_name("cluster_marey")
    printed = capsys.readouterr()
    assert printed.out.endswith(f"\nReport: {out / 'report.html'}\n")
    agreed_verdict(out / "run.json", printed=printed.out, page=out / "report.html")
    assert "points: 9 of 9" in printed.err
    assert (out / "shapes.npz").is_file()
    assert run(["view", str(out), "--no-browser"]) == 0
    assert capsys.readouterr().out.strip().endswith("report.html")


def test_wrong_input_is_one_line_after_the_notes_and_leaves_nothing(tmp_path, capsys):
    np.savez(tmp_path / "given.npz", tracks=np.ones((9, 3)))
    assert run(["nonrigid", str(tmp_path / "given.npz"), "--quiet"]) == WRONG_INPUT
    *notes, text = capsys.readouterr().err.splitlines()
    assert text.startswith(f"marey: {tmp_path / 'given.npz'}: ")
    assert "has tracks of shape (9, 3)" in text
    assert all(note.startswith("Note: ") for note in notes)
    assert not (tmp_path / "given_marey").exists()


def test_ctrl_c_has_its_own_exit_code(points, monkeypatch):
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("marey.pipelines.nonrigid.shapes.write_results", stopped)
    assert run(["nonrigid", str(points), "--basis-shapes", "2", "--quiet"]) == INTERRUPTED


def test_all_options_reach_the_pipeline(tmp_path, monkeypatch):
    given: dict[str, Any] = {}

    def factorise(inputs: list[Path], **options: Any) -> SimpleNamespace:
        given.update(options, inputs=inputs)
        return SimpleNamespace(summary=lambda: Summary("", {}), verdict=None)

    monkeypatch.setattr("marey.pipelines.nonrigid.factorise.factorise", factorise)
    words = ["nonrigid", "a.mp4", "b.mp4", "--points", "p.npz", "--points", "q.npz", "--mask", "m.png", "--scaled"]
    words += ["--matrix", "7,7,3,2", "--cameras", "c.toml", "--distance", "0", "4", "0.3", "--only", "thigh_*,knee"]
    words += ["--basis-shapes", "3", "--frames", "5:30", "--no-overlay", "-o", str(tmp_path / "out"), "-q"]
    assert run(words) == 0
    del given["progress"]
    assert given == {
        "inputs": [Path("a.mp4"), Path("b.mp4")], "points": [Path("p.npz"), Path("q.npz")], "mask": Path("m.png"),
        "matrix": "7,7,3,2", "scaled": True, "cameras": Path("c.toml"), "distance": (0, 4, 0.3),
        "only": ("thigh_*", "knee"), "frames": (5, 30), "basis_shapes": 3, "overlay": False, "out": tmp_path / "out",
    }  # fmt: skip
