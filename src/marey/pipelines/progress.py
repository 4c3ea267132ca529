"""How a pipeline reports its stages, its messages and its warnings."""

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol

Step = Callable[[], None]
"""Reports that one more step of a stage is finished."""

_HUNDREDTHS = 100
"""Steps into which a stage is divided that reports the finished share of its work."""


class Progress(Protocol):
    """What a pipeline needs from a progress reporter.

    Subclass `RecordingProgress` to show the progress elsewhere, for example in a window.

    Example:
        >>> import marey
        >>> def halve(values: list[float], progress: marey.Progress) -> list[float]:
        ...     halves = []
        ...     with progress.stage("Halving", len(values)) as step:
        ...         for value in values:
        ...             halves.append(0.5 * value)
        ...             step()
        ...     return halves
        >>> halve([2.0, 4.0], marey.RecordingProgress())
        [1.0, 2.0]
    """

    timings: dict[str, float]
    """Seconds by stage; a stage that is entered again adds to its time."""
    steps: dict[str, dict[str, float]]
    """Seconds by step, for the stages that name their steps."""
    warnings: list[str]
    """All warnings so far, for the report."""

    def stage(self, name: str, total: int | None = None, *, done: int = 0) -> AbstractContextManager[Step]:
        """Open a stage of a known or unknown number of steps."""

    def stage_of_shares(self, name: str) -> AbstractContextManager[Callable[[float], None]]:
        """Open a stage that reports which share of its work is finished."""

    def stage_of_steps(self, name: str) -> AbstractContextManager[Callable[[str, float], None]]:
        """Open a stage that reports the name of the step that begins."""

    def report(self, text: str) -> None:
        """Report an intermediate result."""

    def warn(self, text: str) -> None:
        """Report something that the user should check."""


class RecordingProgress:
    """Record timings and warnings, and show nothing.

    A subclass shows the progress by overriding `_show`, `report` and `warn`.

    Example:
        >>> import marey
        >>> progress = marey.RecordingProgress()
        >>> with progress.stage("Silhouettes", 2) as step:
        ...     step()
        >>> list(progress.timings)
        ['Silhouettes']
    """

    def __init__(self) -> None:
        self.timings: dict[str, float] = {}
        """Seconds by stage; a stage that is entered again adds to its time."""
        self.steps: dict[str, dict[str, float]] = {}
        """Seconds by step, for the stages that name their steps."""
        self.warnings: list[str] = []
        """All warnings so far, for the report."""

    def report(self, text: str) -> None:
        """Report an intermediate result; it is not kept."""

    def warn(self, text: str) -> None:
        """Report something that the user should check, and keep it for the report."""
        self.warnings.append(text)

    @contextmanager
    def stage(self, name: str, total: int | None = None, *, done: int = 0) -> Iterator[Step]:
        """Open a stage of a known or unknown number of steps.

        Args:
            name: Name of the stage, for example "Silhouettes".
            total: Number of steps; None if it is unknown.
            done: Number of steps that an interrupted run has finished already.

        Yields:
            A function to be called after each step.
        """
        with self._counted(name, total, done) as steps:
            yield lambda: steps(1)

    @contextmanager
    def stage_of_shares(self, name: str) -> Iterator[Callable[[float], None]]:
        """Open a stage that reports which share of its work is finished.

        Args:
            name: Name of the stage.

        Yields:
            A function to be called with the finished share, from 0 to 1.
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
        """Open a stage that reports the name of the step that begins; the steps are timed as well.

        Args:
            name: Name of the stage.

        Yields:
            A function to be called at the beginning of each step with its name and the finished share of the stage.
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
    def _counted(self, name: str, total: int | None, done: int = 0) -> Iterator[Callable[[int], None]]:
        """Open a stage and record its time; yield a function that takes a number of finished steps."""
        started = time.perf_counter()
        try:
            with self._show(name, total, done) as steps:
                yield steps
        finally:
            self.timings[name] = self.timings.get(name, 0.0) + time.perf_counter() - started

    @contextmanager
    def _show(self, name: str, total: int | None, done: int) -> Iterator[Callable[[int], None]]:
        """Show a stage; yield a function that takes a number of finished steps."""
        yield lambda number: None


def readable_seconds(seconds: float) -> str:
    """Format a duration: `4.2 s`, `3 min 20 s` or `1 h 05 min`."""
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"
