import io
import itertools
import re
from contextlib import contextmanager

import pytest

from marey.pipelines import progress as module
from marey.pipelines.progress import Progress, readable_seconds


def test_away_from_a_terminal_stages_are_plain_lines_with_the_time_left(monkeypatch):
    monkeypatch.setattr(module, "SECONDS_BETWEEN_LINES", 0.0)
    stream = io.StringIO()
    progress = Progress(stream)
    with progress.stage("Silhouettes", 4, done=2) as step:
        step()
        step()
    lines = stream.getvalue().splitlines()
    assert lines[0] == "Silhouettes ... 2 of 4 were done before"
    assert re.match(r"Silhouettes: 3 of 4, about .* left", lines[1])
    assert "\x1b" not in stream.getvalue()
    assert lines[-1].startswith("Silhouettes: done in")


def test_times_of_a_stage_add_up_even_when_it_fails():
    progress = Progress(io.StringIO())
    with pytest.raises(ValueError, match="no"), progress.stage("Start"):
        raise ValueError("no")
    first = progress.timings["Start"]
    with progress.stage("Start"):
        pass
    assert progress.timings["Start"] >= first


def test_quiet_shows_warnings_only_and_keeps_them():
    stream = io.StringIO()
    progress = Progress(stream, quiet=True)
    with progress.stage("Start", 3) as step:
        step()
    progress.say("hello")
    progress.warn("cam02 is dark [really]")
    assert stream.getvalue() == "Note: cam02 is dark [really]\n"
    assert progress.warnings == ["cam02 is dark [really]"]


def test_on_a_terminal_there_is_a_bar():
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    stream = Terminal()
    with Progress(stream).stage("Poses", 2) as step:
        step()
        step()
    assert "2/2" in stream.getvalue()


def test_spans_of_time_are_readable():
    spans = {4.23: "4.2 s", 59.99: "1 min 00 s", 200: "3 min 20 s", 3900: "1 h 05 min"}
    assert {s: readable_seconds(s) for s in spans} == spans


def test_shares_of_a_work_are_told_in_hundredths(monkeypatch):
    steps = []
    progress = Progress(io.StringIO())

    @contextmanager
    def counted(name, total):
        steps.append((name, total))
        yield steps.append

    monkeypatch.setattr(progress, "_counted", counted)
    with progress.stage_of_shares("Bones") as done:
        done(0.25)
        done(0.25)
        done(0.31)
        done(1.0)
    assert steps == [("Bones", 100), 25, 6, 69]


def test_a_large_share_at_once_is_told_as_one(monkeypatch):
    shown, clock = io.StringIO(), itertools.count(0, 30.0)
    monkeypatch.setattr("marey.pipelines.progress.time.perf_counter", lambda: next(clock))
    with Progress(shown).stage_of_shares("Shapes") as done:
        done(0.5)
    lines = shown.getvalue().splitlines()
    assert lines[0] == "Shapes ..."
    assert lines[1].startswith("Shapes: 50 of 100, about 30")


def test_the_steps_of_a_stage_are_timed_beside_it():
    progress = Progress(io.StringIO(), quiet=True)
    with progress.stage_of_steps("Bones") as begin:
        begin("growing", 0.0)
        begin("edges", 0.5)
        begin("edges", 0.8)
    assert list(progress.timings) == ["Bones"]
    assert list(progress.steps["Bones"]) == ["growing", "edges"]
    assert 0 < sum(progress.steps["Bones"].values()) <= progress.timings["Bones"]
