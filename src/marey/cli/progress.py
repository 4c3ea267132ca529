"""Progress of a command: bars with the time left on a terminal, plain lines elsewhere."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bars

from marey.cli.compilation import CompilationClock
from marey.cli.time_left import TimeLeft
from marey.pipelines.progress import RecordingProgress, readable_seconds

SECONDS_BETWEEN_LINES = 10.0
"""Least time between two lines of the same stage where there is no terminal [s]."""
COMPILING = "compiling, first run only"
"""What the program reports while it compiles kernels that are not in its cache."""


class TerminalProgress(RecordingProgress):
    """Show the stages of a command one after the other.

    Args:
        stream: Stream for the lines; standard error by default, so that standard output is left for results.
        quiet: Show nothing but warnings.
    """

    def __init__(self, stream: TextIO | None = None, *, quiet: bool = False):
        super().__init__()
        self._stream = sys.stderr if stream is None else stream
        self._quiet = quiet
        self._console = Console(file=self._stream, highlight=False, soft_wrap=True)
        self._announce: Callable[[], None] = lambda: None
        self.compilation = CompilationClock(lambda: self._announce())
        """Time spent on compilation, which does not count in the estimate of the time left."""

    def report(self, text: str) -> None:
        """Show a line."""
        if not self._quiet:
            self._console.print(text, markup=False)

    def warn(self, text: str) -> None:
        """Show a line that the user should see, and keep it for the report."""
        super().warn(text)
        self._console.print(f"Note: {text}", style="yellow" if self._console.is_terminal else None, markup=False)

    @contextmanager
    def _show(self, name: str, total: int | None, done: int) -> Iterator[Callable[[int], None]]:
        show = super()._show if self._quiet else self._bar if self._console.is_terminal else self._lines
        with show(name, total, done) as steps:
            try:
                yield steps
            finally:
                self._announce = lambda: None

    def _working_seconds(self) -> float:
        """Return a clock that stops while kernels are compiled [s]."""
        return time.perf_counter() - self.compilation.seconds

    @contextmanager
    def _bar(self, name: str, total: int | None, done: int) -> Iterator[Callable[[int], None]]:
        left = TimeLeft(total or 1, done=done, started=self._working_seconds())
        columns = (
            SpinnerColumn(finished_text="[green]✓"), TextColumn("{task.description:<20}", markup=False),
            BarColumn(bar_width=14), MofNCompleteColumn(), TimeElapsedColumn(),
            TextColumn("{task.fields[left]}", markup=False),
        )  # fmt: skip
        with Bars(*columns, console=self._console) as bars:
            task = bars.add_task(name, total=total, completed=done, left="")
            self._announce = lambda: bars.update(task, left=COMPILING, refresh=True)

            def steps(number: int) -> None:
                left.add(number, self._working_seconds())
                bars.update(task, advance=number, left=self._left_text(left))

            yield steps
            bars.update(task, total=total or 1, completed=total or 1, left="")

    def _left_text(self, left: TimeLeft) -> str:
        if self.compilation.running:
            return COMPILING
        seconds = left.estimate(self._working_seconds())
        return "" if seconds is None else f"about {readable_seconds(seconds)} left"

    @contextmanager
    def _lines(self, name: str, total: int | None, done: int) -> Iterator[Callable[[int], None]]:
        started = last = time.perf_counter()
        left = TimeLeft(total or 1, done=done, started=self._working_seconds())
        count, announced = done, False
        self.report(f"{name} ..." + (f" {done} of {total} finished by an earlier run" if done else ""))

        def announce() -> None:
            nonlocal announced
            if not announced:
                announced = True
                self.report(f"{name}: {COMPILING}")

        self._announce = announce

        def steps(number: int) -> None:
            nonlocal count, last
            count += number
            left.add(number, self._working_seconds())
            now = time.perf_counter()
            if total and count < total and now - last >= SECONDS_BETWEEN_LINES:
                last = now
                seconds = left.estimate(self._working_seconds())
                about = "" if seconds is None else f", about {readable_seconds(seconds)} left"
                self.report(f"{name}: {count} of {total}{about}")

        yield steps
        self.report(f"{name}: done in {readable_seconds(time.perf_counter() - started)}")
