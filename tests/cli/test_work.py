"""The end of a command: its verdict, where its results are, and the exit code."""

from pathlib import Path

import pytest
import typer

from marey.cli.work import NOT_USABLE, end_with_verdict
from marey.pipelines.verdict import Verdict, VerdictReason


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
