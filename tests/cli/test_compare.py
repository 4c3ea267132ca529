"""`marey compare`: options, printed text and exit codes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.verdicts import agreed_verdict

from marey.cli.main import WRONG_INPUT, run
from marey.cli.work import NOT_USABLE
from marey.io.opensim.mot_sto import TimeSeriesTable, write_table
from marey.pipelines.compare import CompareOptions, compare_files

TIME = np.arange(0, 4, 0.01)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    knee = 35 - 30 * np.cos(5 * TIME) + 5 * np.sin(11 * TIME) + 3 * TIME
    for name, column, values in (("ours", "right_knee_flexion", knee), ("odd", "Knie", -knee)):
        table = TimeSeriesTable(name=name, columns=(column,), time=TIME, values=values[:, None])
        write_table(tmp_path / f"{name}.mot", table)
    (tmp_path / "names.toml").write_text('[angles]\nright_knee_flexion = "-Knie"\n')
    return tmp_path


def test_two_files_are_compared_and_the_path_of_the_report_is_printed(folder, capsys):
    assert run(["compare", "ours.mot", "odd.mot", "--map", "names.toml"]) == 0
    printed = capsys.readouterr()
    assert printed.out.endswith("\nReport: ours_compared_with_odd/report.html\n")
    results = Path("ours_compared_with_odd")
    agreed_verdict(results / "run.json", printed=printed.out, page=results / "report.html")
    assert "right knee flexion" in printed.err.replace("_", " ")
    assert (folder / "ours_compared_with_odd" / "compare.csv").is_file()


@pytest.mark.parametrize(
    ("arguments", "wrong"),
    [(["nothing.mot", "ours.mot"], "nothing.mot: does not exist"), (["ours.mot", "odd.mot"], "--map")],
)
def test_wrong_input_is_one_clear_line_and_leaves_nothing(folder, capsys, arguments, wrong):
    before = sorted(folder.iterdir())
    assert run(["compare", *arguments]) == WRONG_INPUT
    error = capsys.readouterr().err
    assert wrong in error
    assert [line for line in error.splitlines() if line.startswith("marey:")] == [error.splitlines()[-1]]
    assert sorted(folder.iterdir()) == before


def test_all_options_reach_the_pipeline(folder, monkeypatch):
    given: list[Any] = []

    def recorded(first: Path, second: Path, options: CompareOptions, progress: Any) -> Any:
        given.extend([first, second, options])
        return compare_files(first, second, CompareOptions(named=options.named), progress)

    monkeypatch.setattr("marey.pipelines.compare.compare_files", recorded)
    words = ["compare", "ours.mot", "odd.mot", "--map", "names.toml", "--shift", "0.5", "--same-laboratory", "-q"]
    assert run([*words, "--out", "both"]) == 0
    first, second, options = given
    assert (first, second) == (Path("ours.mot"), Path("odd.mot"))
    assert (options.named, options.shift_s, options.same_laboratory) == (Path("names.toml"), 0.5, True)
    assert (folder / "both" / "report.html").is_file()


def test_a_cause_of_disagreement_is_on_terminal_page_and_record_and_in_the_exit_code(folder, capsys):
    knee = 35 - 30 * np.cos(5 * TIME) + 5 * np.sin(11 * TIME) + 3 * TIME
    values = np.radians(knee)[:, None]
    table = TimeSeriesTable(name="radians", columns=("right_knee_flexion",), time=TIME, values=values)
    write_table(folder / "radians.mot", table)
    assert run(["compare", "ours.mot", "radians.mot", "--out", "both"]) == NOT_USABLE
    verdict = agreed_verdict(Path("both/run.json"), printed=capsys.readouterr().out, page=Path("both/report.html"))
    assert "The angles of the first motion are 57 times those of the second" in verdict.reasons[0].what
