"""Reading the tasks of OpenSim's inverse kinematics (IKTaskSet): weights and values of markers and coordinates."""

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.jointed_body import JointedBody
from marey.errors import FileProblem, MareyError
from marey.io.documents import read_xml
from marey.io.opensim.mot_sto import read_table
from marey.io.opensim.osim_functions import numbers, text, truth
from marey.markers.kinematics.tasks import CoordinateTask, MarkerTask, TaskSet

_VALUES = ("default_value", "manual_value", "from_file")
"""Sources of the value of a coordinate's task in OpenSim; the first is the default."""


def read_tasks(path: Path | str) -> TaskSet:
    """Read the tasks of a weights file, or of the setup of OpenSim's inverse kinematics tool.

    As in OpenSim, tasks with `apply` false are skipped.

    Args:
        path: An XML with an `IKTaskSet`.

    Returns:
        The tasks.

    Raises:
        FileProblem: The file has no task set, no marker task, an unsupported task, or an invalid number.
    """
    root = read_xml(path, "Give the weights of OpenSim's inverse kinematics.")
    held = root if root.tag == "IKTaskSet" else root.find(".//IKTaskSet")
    if held is None:
        raise FileProblem(path, f"has no IKTaskSet but <{root.tag}>", "Give a weights file of OpenSim.")
    objects = held.find("objects")
    markers: list[MarkerTask] = []
    coordinates: list[CoordinateTask] = []
    for element in [] if objects is None else objects:
        name = element.get("name", "")
        if not truth(element, "apply", True):
            continue
        weight = float(numbers(path, element, "weight", f"the task {name!r}", np.ones(1))[0])
        if element.tag == "IKMarkerTask":
            markers.append(MarkerTask(label=name, weight=weight))
        elif element.tag == "IKCoordinateTask":
            coordinates.append(_coordinate(path, element, name, weight))
        else:
            raise FileProblem(
                path, f"has the task {name!r}, a {element.tag}, which is not supported",
                "The supported tasks are IKMarkerTask and IKCoordinateTask.",
            )  # fmt: skip
    if not markers:
        raise FileProblem(path, "has no applied marker task", "Set <apply> to true for the markers to use.")
    try:
        return TaskSet(markers=tuple(markers), coordinates=tuple(coordinates))
    except MareyError as error:
        raise FileProblem(path, f"has invalid tasks ({str(error).rstrip('.')})", "Correct the tasks.") from error


def _coordinate(path: Path | str, element: Element, name: str, weight: float) -> CoordinateTask:
    """Read the task of a coordinate."""
    source = text(element, "value_type", _VALUES[0])
    if source not in _VALUES:
        raise FileProblem(
            path, f"has the value_type {source!r} in the task {name!r}", f"It should be one of {', '.join(_VALUES)}."
        )
    manual = source == "manual_value"
    value = float(numbers(path, element, "value", f"the task {name!r}", np.zeros(1))[0]) if manual else None
    return CoordinateTask(coordinate=name, weight=weight, value=value, from_file=source == "from_file")


def read_task_values(path: Path | str, tasks: TaskSet, model: JointedBody, time: Floats) -> dict[str, Floats]:
    """Read the values of tasks whose source is a file, at the times of a trial.

    The file is the MOT or STO that `<coordinate_file>` names, relative to the folder of the weights file. Values are
    interpolated linearly between its rows.

    Args:
        path: The weights file.
        tasks: The tasks from this file.
        model: The model, which distinguishes angles, possibly in degrees in the file, from lengths.
        time: (F,) times of the trial [s].

    Returns:
        (F,) values [rad or m] by coordinate; empty if no task takes its value from a file.

    Raises:
        FileProblem: No file is named, or the file lacks a coordinate or does not cover the times.
    """
    wanted = [task.coordinate for task in tasks.coordinates if task.from_file]
    if not wanted:
        return {}
    named = read_xml(path, "Give the weights of OpenSim's inverse kinematics.").find(".//coordinate_file")
    place = ((named.text or "") if named is not None else "").strip()
    if not place or place == "Unassigned":
        raise FileProblem(
            path, f"takes the value of {', '.join(wanted)} from a file but does not name the file",
            "Name a MOT in <coordinate_file>, or set <value_type> to manual_value.",
        )  # fmt: skip
    file = Path(path).parent / place
    table = read_table(file)
    missing = [name for name in wanted if name not in table.columns]
    if missing:
        raise FileProblem(file, f"has no column {', '.join(missing)}", f"It has {', '.join(table.columns)}.")
    # The times of a trial and of a motion computed from it may differ by rounding.
    half = 0.5 * float(np.median(np.diff(table.time))) if len(table.time) > 1 else 0.0
    if time[0] < table.time[0] - half or time[-1] > table.time[-1] + half:
        raise FileProblem(
            file, f"covers {table.time[0]:g} to {table.time[-1]:g} s, but the trial {time[0]:g} to {time[-1]:g} s",
            "Give values for the entire trial.",
        )  # fmt: skip
    values = {}
    for name in wanted:
        column = np.interp(time, table.time, table.values[:, table.columns.index(name)])
        turns = table.in_degrees and model.coordinates[model.coordinate(name)].rotational
        values[name] = np.radians(column) if turns else column
    return values
