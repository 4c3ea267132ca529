"""The runner lists, runs and records benchmarks."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from bench.declaration import Bench
from bench.recording import Column, Run

from bench import __main__ as runner


class MadeModule:
    """A benchmark without a module of its own."""

    __doc__ = "A made benchmark."

    def arguments(self, parser):
        parser.add_argument("takes", nargs="*")
        parser.add_argument("--file", type=Path)

    def run(self, run: Run) -> None:
        (run.out / "result.txt").write_text("kept")
        run.table("Takes", "take", Column("joints", "mm", 1)).row(" ".join(run.arguments.takes), 1.25)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """The runner with one made benchmark and its own folder of records."""

    class MadeBench(Bench):
        def module(self):
            return MadeModule()

    bench = MadeBench(measures="A length.", sources=("src",), minutes=1, name="capture/made")
    monkeypatch.setattr(runner, "find_benches", lambda: {bench.name: bench})
    monkeypatch.setattr(runner, "PROJECT", tmp_path)
    written = runner.record_path
    monkeypatch.setattr(runner, "record_path", lambda name, words: written(name, words, tmp_path / "records"))
    (tmp_path / "shared" / "data").mkdir(parents=True)
    return tmp_path


def run(made: Path, *words: str) -> int:
    return runner.main(["run", "capture/made", "--shared", str(made / "shared"), *words])


def test_a_run_prints_figures_and_writes_a_record(made: Path, capsys: pytest.CaptureFixture[str]):
    assert run(made, "walk", "reach", "--note", "Shared machine.") == 0
    assert "walk reach | 1.2" in capsys.readouterr().out
    record = json.loads((made / "records" / "capture" / "made.walk.reach.json").read_text())
    assert record["command"] == "python -m bench run capture/made walk reach"
    assert record["note"] == "Shared machine."
    assert len(record["commit"]) == 40
    assert record["tables"][0]["rows"] == [{"labels": ["walk reach"], "values": [1.25]}]


def test_a_record_contains_no_path_of_this_machine(made: Path):
    run(made, "--out", str(made / "kept"), "--file", str(made / "body.npz"))
    text = next((made / "records" / "capture").glob("made*.json")).read_text()
    assert str(made) not in text
    assert "--file body.npz" in text


def test_results_are_kept_apart_by_commit(made: Path):
    run(made, "--out", str(made / "kept"))
    commit = runner.current_commit()[:7]
    assert [path.name.removesuffix("-dirty") for path in (made / "kept").iterdir()] == [commit]


def test_nothing_is_recorded_with_no_record(made: Path):
    run(made, "--no-record")
    assert not (made / "records").exists()


def test_an_unknown_name_ends_with_an_error(made: Path, capsys: pytest.CaptureFixture[str]):
    assert runner.main(["run", "capture/other"]) == 2
    assert "python -m bench list" in capsys.readouterr().err


def test_missing_recordings_are_named(made: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        runner.main(["run", "capture/made", "--shared", str(made / "nowhere")])
    assert "has no folder `data`" in capsys.readouterr().err


@pytest.mark.slow
def test_the_list_needs_no_more_than_python():
    """Importing nothing but the standard library: -S leaves out the installed packages."""
    project = Path(__file__).parents[2]
    listed = subprocess.run(
        [sys.executable, "-S", "-m", "bench", "list", "speed"], cwd=project, capture_output=True, text=True, check=True
    )
    assert "speed/level_set" in listed.stdout
    assert "capture/takes" not in listed.stdout
