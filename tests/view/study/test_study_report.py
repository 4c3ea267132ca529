"""The page of a study."""

import re

import numpy as np

from marey.io.study.tables import MeanRow, StudyRow, SubjectRow, TrialRow
from marey.view.pages.html import PageHead
from marey.view.study.study_report import StudyContent, StudyCurve, write_study_report
from marey.view.svg.dot_plots import dot_plot

OWN = {"step": "markers", "quantity": "speed", "side": "both", "unit": "m/s"}


def mean(condition: str, value: float, **given) -> MeanRow:
    usual = {"minus": "", "kind": "mean", "subjects": 2, "trials": 4, "between_subjects_sd": 0.05, "weighted": True}
    return MeanRow(
        condition=condition, mean=value, low95=value - 0.1, high95=value + 0.1, **OWN, **{**usual, **given}
    )  # fmt: skip


def subject(name: str, condition: str, value: float) -> SubjectRow:
    return SubjectRow(
        condition=condition, subject=name, trials=2, mean=value, standard_error=0.02, low95=value - 1, high95=value + 1,
        **OWN,
    )  # fmt: skip


def trial(name: str, **given) -> TrialRow:
    usual = {
        "state": "done", "verdict": "good", "reason": "", "report": f"{name}/markers/report.html", "interruptions": 0,
    }  # fmt: skip
    return TrialRow(
        trial=name, subject="S01", condition="slow", step="markers", seconds=1.5, memory_mb=200.0, **{**usual, **given}
    )


def written(path, **given) -> str:
    row = StudyRow(
        trial="S01/a b", subject="S01", condition="slow", value=1.0, low95=0.9, high95=np.nan, cycles=4,
        flags="outlier; no interval", **OWN,
    )  # fmt: skip
    usual = {
        "trials": [trial("S01/a b"), trial("S01/c", state="failed", verdict="", report="", reason="<broken>")],
        "rows": [row], "subjects": [subject("S01", "slow", 1.0), subject("S02", "fast", 1.4)],
        "means": [mean("slow", 1.0), mean("fast", 1.4), mean("fast", 0.4, minus="slow", kind="paired difference")],
    }  # fmt: skip
    write_study_report(path, StudyContent(title="gait", head=PageHead(), **{**usual, **given}))
    return path.read_text(encoding="utf-8")


def test_the_page_links_the_reports_and_shows_failures_first_and_loads_nothing(tmp_path):
    text = written(tmp_path / "study.html")
    assert '<a href="S01/a%20b/markers/report.html">S01/a b</a>' in text
    assert text.index("&lt;broken&gt;") < text.index("S01/a%20b")
    assert not re.search(r'(?:src|href)="(?:https?:)?//', text)


def test_means_differences_outliers_and_missing_intervals_are_shown(tmp_path):
    text = written(tmp_path / "study.html")
    assert "1.00 [0.90, 1.10] (2 subjects, 4 trials; SD 0.05)" in text
    assert "fast − slow" in text
    assert "0.40 [0.30, 0.50]" in text
    assert "1 of 1 interval excludes zero" in text
    assert "Some values have no interval: speed." in text
    assert 'id="table-3"' in text
    curve = StudyCurve(
        name="left_knee_flexion_deg", condition="slow", mean=np.zeros(101), between_sd=np.ones(101), subjects=3
    )
    assert "slow, 3 subjects" in written(tmp_path / "curves.html", curves=[curve])


def test_a_study_without_any_result_has_a_page(tmp_path):
    text = written(tmp_path / "study.html", rows=[], subjects=[], means=[])
    assert 'id="subjects"' not in text
    assert "0 complete" not in text


def test_dots_lie_in_the_order_of_their_values_within_the_plot():
    subjects = [subject(f"S{k}", "slow", 1.0 + 0.1 * k) for k in range(4)]
    plot = dot_plot("speed <m/s>", [mean("slow", 1.15)], subjects)
    assert plot is not None
    places = [float(x) for x in re.findall(r'<circle cx="([\d.]+)"', plot.svg)]
    assert places == sorted(places)
    assert len(set(places)) == 4
    assert 'aria-label="speed &lt;m/s&gt;"' in plot.svg
    numbers = [float(x) for x in re.findall(r' x[12]="([-\d.]+)"', plot.svg)]
    assert 112 <= min(numbers) <= max(numbers) <= 340
    assert dot_plot("speed", [mean("slow", np.nan)], []) is None
