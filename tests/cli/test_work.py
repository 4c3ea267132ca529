"""The end of a command: its verdict, where its results are, and the exit code."""

from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from marey.cli.main import app
from marey.cli.work import NOT_USABLE, end_with_verdict, working
from marey.pipelines.verdict import Verdict, VerdictReason
from marey.process import usable_cores


def test_the_page_to_open_is_the_last_line(capsys):
    end_with_verdict(Verdict.of([VerdictReason.limit("One is late.")]), cameras=Path("a.toml"), report=Path("r.html"))
    lines = capsys.readouterr().out.splitlines()
    assert lines == ["Verdict: usable with limits", "- One is late.", "Cameras: a.toml", "Report: r.html"]


def test_a_result_that_is_not_usable_has_its_own_exit_code(capsys):
    with pytest.raises(typer.Exit) as ended:
        end_with_verdict(Verdict.of([VerdictReason.failure("Nothing was found.")]), report=Path("r.html"))
    assert ended.value.exit_code == NOT_USABLE
    assert capsys.readouterr().out.endswith("Report: r.html\n")


def test_results_of_earlier_versions_have_no_verdict(capsys):
    end_with_verdict(None, report=Path("r.html"), summary=None)
    assert capsys.readouterr().out == "Report: r.html\n"


def test_the_work_uses_as_many_cores_as_it_may():
    before = usable_cores()
    for parallel_cameras in (True, False):
        with working(quiet=True, parallel_cameras=parallel_cameras, workers=3):
            assert usable_cores() == 3
    with working(quiet=True):
        assert usable_cores() == before


@pytest.mark.parametrize("command", ["capture", "surface", "shape", "sync", "calibrate"])
@pytest.mark.parametrize("workers", ["0", "-2", "many"])
def test_a_wrong_number_of_cores_is_refused_before_the_work(tmp_path, command, workers):
    ended = CliRunner().invoke(app, [command, str(tmp_path), "--workers", workers])
    assert ended.exit_code == 2
    assert "--workers" in ended.output


def test_the_environment_may_limit_the_cores(tmp_path):
    ended = CliRunner().invoke(app, ["capture", str(tmp_path)], env={"MAREY_WORKERS": "0"})
    assert ended.exit_code == 2
    assert "MAREY_WORKERS" in ended.output
