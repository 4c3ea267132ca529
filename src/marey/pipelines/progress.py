"""Telling how far a long work is: bars with the time left on a terminal, plain lines elsewhere."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as Bars

SECONDS_BETWEEN_LINES = 10.0
_HUNDREDTHS = 100
Step = Callable[[], None]


class Progress:
    """Shows the stages of a work one after the other, and keeps how long each took.

    Args:
        stream: Where it is shown; standard error when missing, so that standard output stays for results.
        quiet: Show nothing but warnings.
    """

    def __init__(self, stream: TextIO | None = None, *, quiet: bool = False):
        self._stream = sys.stderr if stream is None else stream
        self._quiet = quiet
        self._console = Console(file=self._stream, highlight=False, soft_wrap=True)
        self.timings: dict[str, float] = {}
        """Seconds by stage; a stage that is entered again adds to its time."""
        self.steps: dict[str, dict[str, float]] = {}
        """Of the stages that tell their steps, seconds by step."""
        self.warnings: list[str] = []
        """What was warned of, for the report."""

    def say(self, text: str) -> None:
        """Show a line."""
        if not self._quiet:
            self._console.print(text, markup=False)

    def warn(self, text: str) -> None:
        """Show a line that the user should see, and keep it for the report."""
        self.warnings.append(text)
        self._console.print(f"Note: {text}", style="yellow" if self._console.is_terminal else None, markup=False)

    @contextmanager
    def stage(self, name: str, total: int | None = None, *, done: int = 0) -> Iterator[Step]:
        """Show one stage.

        Args:
            name: What is being done, for example "Silhouettes".
            total: How many steps it takes; None where nobody knows.
            done: How many of them an interrupted run had done already.

        Yields:
            A function to be called after each step.
        """
        with self._counted(name, total, done) as steps:
            yield lambda: steps(1)

    @contextmanager
    def _counted(self, name: str, total: int | None, done: int = 0) -> Iterator[Callable[[int], None]]:
        """Show one stage; what is yielded takes a number of steps."""
        started = time.perf_counter()
        show = self._silent if self._quiet else self._bar if self._console.is_terminal else self._lines
        try:
            with show(name, total, done) as steps:
                yield steps
        finally:
            self.timings[name] = self.timings.get(name, 0.0) + time.perf_counter() - started

    @contextmanager
    def stage_of_shares(self, name: str) -> Iterator[Callable[[float], None]]:
        """Show one stage of a work that tells which share of it is done.

        Args:
            name: What is being done.

        Yields:
            A function to be called with the share, from 0 to 1.
        """
        made = 0

        with self._counted(name, _HUNDREDTHS) as steps:

            def done(share: float) -> None:
                nonlocal made
                more = round(share * _HUNDREDTHS) - made
                if more > 0:
                    made += more
                    steps(more)

            yield done

    @contextmanager
    def stage_of_steps(self, name: str) -> Iterator[Callable[[str, float], None]]:
        """Show one stage of a work that tells which step of it begins; the steps are timed, too.

        Args:
            name: What is being done.

        Yields:
            A function to be called at the beginning of each step with its name, and with the share that is done.
        """
        spent = self.steps.setdefault(name, {})
        last = ""
        since = time.perf_counter()

        def end_last() -> None:
            nonlocal since
            now = time.perf_counter()
            if last:
                spent[last] = spent.get(last, 0.0) + now - since
            since = now

        with self.stage_of_shares(name) as done:

            def begin(step: str, share: float) -> None:
                nonlocal last
                end_last()
                last = step
                done(share)

            yield begin
            end_last()

    @contextmanager
    def _silent(self, name: str, total: int | None, done: int) -> Iterator[Callable[[int], None]]:
        yield lambda number: None

    @contextmanager
    def _bar(self, name: str, total: int | None, done: int) -> Iterator[Callable[[int], None]]:
        columns = (
            SpinnerColumn(finished_text="[green]✓"), TextColumn("{task.description:<28}", markup=False),
            BarColumn(bar_width=28), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"),
            TimeRemainingColumn(),
        )  # fmt: skip
        with Bars(*columns, console=self._console) as bars:
            task = bars.add_task(name, total=total, completed=done)
            yield lambda number: bars.advance(task, number)
            bars.update(task, total=total or 1, completed=total or 1)

    @contextmanager
    def _lines(self, name: str, total: int | None, done: int) -> Iterator[Callable[[int], None]]:
        started = last = time.perf_counter()
        count = done
        self.say(f"{name} ..." + (f" {done} of {total} were done before" if done else ""))

        def steps(number: int) -> None:
            nonlocal count, last
            count += number
            now = time.perf_counter()
            if total and count < total and now - last >= SECONDS_BETWEEN_LINES:
                last = now
                left = (now - started) / max(count - done, 1) * (total - count)
                self.say(f"{name}: {count} of {total}, about {readable_seconds(left)} left")

        yield steps
        self.say(f"{name}: done in {readable_seconds(time.perf_counter() - started)}")


def readable_seconds(seconds: float) -> str:
    """Write a span of time as people say it: `4.2 s`, `3 min 20 s`, `1 h 05 min`."""
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"
