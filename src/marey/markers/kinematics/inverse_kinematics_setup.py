"""Setup of inverse kinematics: the markers common to model, tasks and trial, and the tasks of the coordinates."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.jointed_body import JointedBody
from marey.errors import MareyError
from marey.markers.kinematics.tasks import MarkerTask, TaskSet
from marey.wording import listed

_MOST_LISTED = 8
"""Number of markers of each source that an error message lists. Chosen by hand."""


@dataclass(frozen=True, kw_only=True)
class InverseKinematicsSettings:
    """Settings of inverse kinematics.

    The defaults were chosen by hand; results were not measured against other values.
    """

    most_steps: int = 200
    """Most steps from the posture of the previous frame."""
    search_steps: int = 20
    """Most steps of the whole body from each initial orientation of a search."""
    restart_ratio: float = 3.0
    """A frame whose RMS residual exceeds this multiple of the recent median starts a new search."""
    recent_frames: int = 50
    """Frames in the recent median."""
    good_rms_m: float = 1e-3
    """A frame with a smaller RMS residual [m] needs no search."""
    largest_sd: float = 0.5
    """A coordinate with a larger standard deviation is undetermined [rad or m]."""
    marker_share: float = 0.5
    """Smallest share of a coordinate's information that must come from markers; otherwise a task determines it."""


INVERSE_KINEMATICS_DEFAULTS = InverseKinematicsSettings()
"""Default settings of inverse kinematics."""


class InverseKinematicsSetup(NamedTuple):
    """Data of inverse kinematics that are the same in all frames."""

    model: JointedBody
    labels: tuple[str, ...]
    body: Integers
    """(M,) index of each marker's body, -1 for the ground."""
    place: Floats
    """(M, 3) position of each marker on its body [m]."""
    weight: Floats
    """(M,) weights of the markers."""
    task_weight: Floats
    """(N,) weights of the coordinate tasks, relative to the markers' weighted mean."""
    target: Floats
    """(F, N) target values of the tasks [rad or m]; 0 without a task."""
    lower: Floats
    """(N,) lower limits [rad or m]."""
    upper: Floats
    """(N,) upper limits [rad or m]."""
    settings: InverseKinematicsSettings = INVERSE_KINEMATICS_DEFAULTS


def set_up(
    model: JointedBody,
    tasks: TaskSet | None,
    in_trial: tuple[str, ...],
    frames: int,
    targets: Mapping[str, Floats],
    settings: InverseKinematicsSettings = INVERSE_KINEMATICS_DEFAULTS,
) -> tuple[InverseKinematicsSetup, tuple[str, ...]]:
    """Match the markers of tasks, model and trial.

    Args:
        model: The body.
        tasks: Weights of markers and coordinates; None uses all markers with equal weights.
        in_trial: Labels of the trial's markers.
        frames: Number F of frames of the trial.
        targets: For tasks `from_file`: values (F,) of each coordinate [rad or m].
        settings: Numbers of steps, and when a frame is searched anew or undetermined.

    Returns:
        The data that are the same in all frames, and notes on the markers that are not used.

    Raises:
        MareyError: No marker is common to all, a task refers to an unknown coordinate, or a target is missing.
    """
    in_model = {m.label for m in model.markers}
    if not in_model:
        raise MareyError(f"The model {model.name!r} has no markers.")
    if tasks is None:
        tasks = TaskSet(markers=tuple(MarkerTask(label=m.label, weight=1.0) for m in model.markers))
    used = [t for t in tasks.markers if t.weight > 0 and t.label in in_model and t.label in in_trial]
    if not used:
        raise MareyError(
            "No marker is common to trial, model and tasks. "
            f"The trial has {listed(in_trial, most=_MOST_LISTED)}; "
            f"the model {listed(sorted(in_model), most=_MOST_LISTED)}; "
            f"the tasks {listed((t.label for t in tasks.markers), most=_MOST_LISTED)}."
        )
    skipped = _unused_markers(tasks, in_model, in_trial)
    task_weight, target = _coordinate_tasks(model, tasks, frames, targets)
    labels = tuple(t.label for t in used)
    body, place = model.marker_bodies(labels)
    setup = InverseKinematicsSetup(
        model=model, labels=labels, body=body, place=place, weight=np.array([t.weight for t in used]),
        task_weight=task_weight, target=target,
        lower=np.array([c.lower for c in model.coordinates]), upper=np.array([c.upper for c in model.coordinates]),
        settings=settings,
    )  # fmt: skip
    return setup, skipped


def _unused_markers(tasks: TaskSet, in_model: set[str], in_trial: tuple[str, ...]) -> tuple[str, ...]:
    """Report the markers that are not used, and why."""
    in_tasks = [t.label for t in tasks.markers]
    reasons = (
        ("markers of the tasks are missing from the model", [n for n in in_tasks if n not in in_model]),
        (
            "markers of the model are missing from the trial",
            [n for n in in_tasks if n in in_model and n not in in_trial],
        ),
        ("markers of the trial are missing from the model", [n for n in in_trial if n not in in_model]),
        ("markers have no task", sorted(n for n in in_model if n in in_trial and n not in in_tasks)),
        ("markers have the weight 0", [t.label for t in tasks.markers if t.weight == 0]),
    )
    return tuple(f"{len(names)} {reason}: {', '.join(names)}" for reason, names in reasons if names)


def _coordinate_tasks(
    model: JointedBody, tasks: TaskSet, frames: int, targets: Mapping[str, Floats]
) -> tuple[Floats, Floats]:
    """Return the weights (N,) and target values (F, N) of the coordinate tasks."""
    weight, target = np.zeros(len(model.coordinates)), np.zeros((frames, len(model.coordinates)))
    for task in tasks.coordinates:
        index = model.coordinate(task.coordinate)
        weight[index] = task.weight
        if not task.from_file:
            target[:, index] = model.coordinates[index].default if task.value is None else task.value
            continue
        given = np.asarray(targets.get(task.coordinate, np.zeros(0)), float)
        if given.shape != (frames,) or not np.isfinite(given).all():
            raise MareyError(
                f"The task of {task.coordinate!r} takes its values from a file, which must contain one number for each "
                f"of the {frames} frames."
            )
        target[:, index] = given
    return weight, target
