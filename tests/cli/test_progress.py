import io
import re

import numba
import pytest

from marey.cli import progress as module
from marey.cli.compilation import CompilationClock, observed_compilation
from marey.cli.progress import COMPILING, TerminalProgress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """A clock that a test advances by changing its only entry."""
    now = [100.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    return now


def test_away_from_a_terminal_stages_are_plain_lines_with_the_time_left(monkeypatch, clock):
    monkeypatch.setattr(module, "SECONDS_BETWEEN_LINES", 0.0)
    stream = io.StringIO()
    with TerminalProgress(stream).stage("Silhouettes", 10, done=4) as step:
        for seconds in (7.0, 2.0, 2.0):
            clock[0] += seconds
            step()
    lines = stream.getvalue().splitlines()
    assert lines[0] == "Silhouettes ... 4 of 10 finished by an earlier run"
    assert lines[1] == "Silhouettes: 5 of 10"
    assert lines[3] == "Silhouettes: 7 of 10, about 6.0 s left"
    assert "\x1b" not in stream.getvalue()
    assert lines[-1].startswith("Silhouettes: done in")


def test_quiet_shows_warnings_only_and_keeps_them():
    stream = io.StringIO()
    progress = TerminalProgress(stream, quiet=True)
    with progress.stage("Start", 3) as step:
        step()
    progress.report("hello")
    progress.warn("cam02 is dark [really]")
    assert stream.getvalue() == "Note: cam02 is dark [really]\n"
    assert progress.warnings == ["cam02 is dark [really]"]


def test_on_a_terminal_there_is_a_bar():
    stream = Terminal()
    with TerminalProgress(stream).stage("Poses", 2) as step:
        step()
        step()
    assert "2/2" in stream.getvalue()


@pytest.mark.parametrize("stream", [io.StringIO(), Terminal()], ids=["lines", "bar"])
def test_compilation_is_announced_once_in_a_stage(stream):
    progress = TerminalProgress(stream)
    with progress.stage("Start", 2) as step:
        for _ in range(2):
            progress.compilation.start()
            progress.compilation.end()
        step()
    assert COMPILING in stream.getvalue()
    if not stream.isatty():
        assert stream.getvalue().count(COMPILING) == 1


def test_the_time_spent_on_compilation_does_not_count_in_the_time_left(monkeypatch, clock):
    monkeypatch.setattr(module, "SECONDS_BETWEEN_LINES", 0.0)
    stream = io.StringIO()
    progress = TerminalProgress(stream)
    with progress.stage("Start", 10) as step:
        for compiling in (0.0, 20.0, 20.0):
            progress.compilation.start()
            clock[0] += compiling
            progress.compilation.end()
            clock[0] += 2.0
            step()
    assert re.search(r"3 of 10, about 14\.0 s left", stream.getvalue())


def test_kernels_that_call_each_other_are_counted_once():
    begun: list[int] = []
    clock = CompilationClock(lambda: begun.append(1))

    @numba.njit
    def inner(x):
        return x + 1.0

    @numba.njit
    def outer(x):
        return 2.0 * inner(x)

    with observed_compilation(clock):
        assert not clock.running
        assert outer(1.0) == 4.0
        first = clock.seconds
        assert outer(2.0) == 6.0
    assert begun == [1]
    assert first > 0
    assert clock.seconds == first
    assert not clock.running
