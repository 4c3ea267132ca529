"""The steps of all trials on the workers: what runs when, and what became of it."""

import math
import os
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from marey.extras import import_optional
from marey.io.study.records import read_step_record
from marey.pipelines.progress import Progress
from marey.pipelines.study.cluster import scheduler_named
from marey.pipelines.study.steps import StepOutcome, StepTask, run_step
from marey.wording import count_of

_AHEAD = 2
"""Number of steps per worker that the scheduler knows at a time: none waits for the client, and the memory of the
scheduler does not grow with the study. Chosen by hand."""
_COUNT_AGAIN_S = 1.0
"""Time after which the workers are counted again [s]. A count is a message that names all of them. Chosen by hand."""
NOT_BEGUN = "not begun"
"""State of a step behind one that failed."""


@dataclass(frozen=True, kw_only=True)
class TrialPlan:
    """The steps of a trial in their order."""

    trial: str
    """Name of the trial."""
    tasks: tuple[StepTask, ...]


def run_plans(
    client: Any, plans: Sequence[TrialPlan], progress: Progress, *, root: Path
) -> dict[tuple[str, str], StepOutcome]:
    """Run the steps of all trials on the workers of a client, those of a trial one after the other.

    Args:
        client: A client of `dask.distributed`.
        plans: The trials.
        progress: Progress reporter; failures are reported when they occur.
        root: The folder of the study; messages name files relative to it.

    Returns:
        The outcome of each step, by trial and step.

    Raises:
        SchedulerLost: The scheduler ended, or the connection to it was lost.
    """
    found: dict[tuple[str, str], StepOutcome] = {}
    total = sum(len(plan.tasks) for plan in plans)
    with progress.stage("Steps of trials", total) as step:
        for each in _outcomes(client, plans):
            outcome = replace(each, message=each.message.replace(f"{root.resolve()}{os.sep}", ""))
            found[outcome.trial, outcome.step] = outcome
            step()
            if outcome.state == "failed":
                progress.warn(f"{outcome.trial}: the step {outcome.step} failed: {outcome.message}")
    return found


def _outcomes(client: Any, plans: Sequence[TrialPlan]) -> Iterator[StepOutcome]:
    distributed = import_optional("distributed", extra="study", purpose="Studies")
    address = client.scheduler.address
    waiting = deque(deque(plan.tasks) for plan in plans if plan.tasks)
    running: dict[Any, tuple[StepTask, deque[StepTask]]] = {}
    ended = distributed.as_completed([], loop=client.loop)
    workers = _Workers(client)

    def begin(tasks: deque[StepTask]) -> None:
        task = tasks.popleft()
        future = client.submit(run_step, task, key=f"{task.trial}: {task.step}", pure=False)
        running[future] = task, tasks
        ended.add(future)

    try:
        while waiting or running:
            with scheduler_named(address):
                while waiting and len(running) < _AHEAD * workers.count():
                    begin(waiting.popleft())
                future = next(ended)
                task, rest = running.pop(future)
                outcome = _outcome_of(future, task)
                future.release()
            yield outcome
            if outcome.state == "failed":
                for other in rest:
                    yield StepOutcome(
                        trial=other.trial, step=other.step, state=NOT_BEGUN, message=f"The step {task.step} failed."
                    )
            elif rest:
                waiting.appendleft(rest)
    finally:
        for future in running:
            future.cancel(force=True)


class _Workers:
    """The number of workers, which may come and go."""

    def __init__(self, client: Any):
        self._client, self._number, self._counted_at = client, 0, -math.inf

    def count(self) -> int:
        """Return the number, which may be some time old; at least 1."""
        if time.monotonic() - self._counted_at > _COUNT_AGAIN_S:
            self._number, self._counted_at = len(self._client.nthreads()), time.monotonic()
        return max(self._number, 1)


def _outcome_of(future: Any, task: StepTask) -> StepOutcome:
    """Return the outcome of a step that has ended, also where its workers have ended with it."""
    error = future.exception()
    if error is None:
        outcome: StepOutcome = future.result()
        return outcome
    record = read_step_record(task.record)
    times = 1 + (record.interruptions if record is not None and record.state == "running" else 0)
    if type(error).__name__ == "KilledWorker":
        they, were = ("it", "was") if times == 1 else ("they", "were")
        limits = "--memory, or on an existing cluster --memory-limit of `dask worker`"
        message = (
            f"{count_of(times, 'worker')} ended while {they} worked on it. {they.capitalize()} {were} killed, or "
            f"needed more memory than {they} may use ({limits})."
        )
    else:
        message = f"its worker was lost ({type(error).__name__}: {error})".splitlines()[0]
    return StepOutcome(trial=task.trial, step=task.step, state="failed", message=message, interruptions=times)
