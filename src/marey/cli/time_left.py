"""Estimate of the time that a stage still takes, from the times of its finished steps."""

from dataclasses import dataclass

LEAST_SHARE = 0.05
"""Finished share of a stage below which there is no estimate."""
LEAST_STEPS = 2
"""Finished steps of a stage below which there is no estimate: the first step alone often compiles and loads."""
LEAST_SECONDS = 3.0
"""Time after the first step before which there is no estimate [s].

In `marey demo` the first frames show no person and take 10 % of the time of the others. Without this limit the
estimates for outlines and overlays were too small by factors of 4 and 6 after 5 % of the frames.
"""
LEAST_REMAINING = 3.0
"""Remaining time below which there is no estimate [s].

What a stage does after its last step is not in the rate of its steps, and the last steps of a short stage often take
other times than those before. Two runs of `marey demo` with an empty kernel cache were traced. After its last step but
one the refinement worked for 0.4 s and compiled for 1.9 s, where the estimate was 0.01 s. In tracking, of six seconds,
the estimate was 2.5 s where 0.8 s were left. Above this limit no estimate was off by more than a factor of three.
"""
RECENT_SHARE = 0.5
"""Share of the finished steps, the latest ones, that determine the rate.

Half of them follow a rate that changes within a stage, and still average over the irregular steps of its beginning.
"""
BATCH_SHARE = 0.1
"""Share of the usual time between reports below which two reports count as one.

Chosen by hand, so that steps which several threads finish at almost the same time are one batch.
"""
HURRIED_SHARE, SURE_SHARE = 0.1, 0.25
"""Share of the first step's time below which the next steps may be of the same batch, and finished share of the stage
from which they are not.

Chosen by hand on simulated stages (tests/cli/test_time_left.py).
"""


@dataclass(frozen=True)
class _Mark:
    """Number of finished steps at a time."""

    steps: int
    seconds: float


class TimeLeft:
    """Estimates the remaining time of a stage from the rate of its latest steps.

    The first step does not count, as it often takes many times as long as the next ones (compilation, opening of
    files). Time that the process is known to have spent on compilation is subtracted.

    Args:
        total: Number of steps of the stage.
        done: Number of steps that an earlier run has finished.
        started: Time at which the stage began [s].
    """

    def __init__(self, total: int, *, done: int = 0, started: float = 0.0):
        self._total, self._done = total, done
        self._marks = [_Mark(done, started)]

    def add(self, number: int, seconds: float) -> None:
        """Record finished steps.

        Args:
            number: How many steps were finished since the last call.
            seconds: Time, without the time spent on compilation [s].
        """
        last = self._marks[-1]
        steps = last.steps + number
        intervals = len(self._marks) - 2
        if intervals > 0 and seconds - last.seconds < BATCH_SHARE * (last.seconds - self._marks[1].seconds) / intervals:
            # Steps that threads or windows finish together are one mark: the time between them carries no information.
            self._marks.pop()
        self._marks.append(_Mark(steps, seconds))

    def estimate(self, seconds: float) -> float | None:
        """Estimate the remaining time.

        Args:
            seconds: Present time, without the time spent on compilation [s].

        Returns:
            Seconds until the stage ends; None as long as too little is known, and at the very end.
        """
        last = self._marks[-1]
        made = last.steps - self._done
        if len(self._marks) <= LEAST_STEPS or made < LEAST_SHARE * (self._total - self._done):
            return None
        if seconds - self._marks[1].seconds < LEAST_SECONDS:
            return None
        if made < SURE_SHARE * self._total and self._hurried(last):
            return None
        since = self._mark_before(last.steps - RECENT_SHARE * made)
        if last.steps <= since.steps:
            return None
        rate = (last.seconds - since.seconds) / (last.steps - since.steps)
        waited = max(seconds - last.seconds, 0.0)
        left = rate * (self._total - last.steps) - min(waited, rate)
        return left if left >= LEAST_REMAINING else None

    def _hurried(self, last: _Mark) -> bool:
        """Return whether all steps after the first one took so little time that they may belong to its batch."""
        begin, first = self._marks[:2]
        return last.seconds - first.seconds < HURRIED_SHARE * (first.seconds - begin.seconds)

    def _mark_before(self, steps: float) -> _Mark:
        """Return the latest mark of at most a number of steps, but never the start of the stage."""
        found = self._marks[1]
        for mark in self._marks[2:-1]:
            if mark.steps > steps:
                break
            found = mark
        return found
