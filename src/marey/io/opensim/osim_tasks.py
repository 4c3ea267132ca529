"""Reading the tasks of OpenSim's inverse kinematics (IKTaskSet): weights and values of markers and coordinates."""

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.jointed_body import JointedBody
from marey.errors import FileProblem, MareyError
from marey.io.opensim.mot_sto import read_table
from marey.io.opensim.osim_functions import numbers, read_xml, text, truth
from marey.markers.kinematics.tasks import CoordinateTask, MarkerTask, TaskSet

_VALUES = ("default_value", "manual_value", "from_file")


def read_tasks(path: Path | str) -> TaskSet:
    """Read the tasks that a weights file, or the setup of OpenSim's inverse kinematics tool, applies.

    Tasks with `apply` false are passed over, as OpenSim does.

    Args:
        path: An XML with an `IKTaskSet`.

    Raises:
        FileProblem: It has no task set, no marker task, a task of another kind, or a damaged number.
    """
    root = read_xml(path, "the weights of OpenSim's inverse kinematics")
    held = root if root.tag == "IKTaskSet" else root.find(".//IKTaskSet")
    if held is None:
        raise FileProblem(path, f"has no IKTaskSet; it holds <{root.tag}>", "Give a weights file of OpenSim.")
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
                path, f"has the task {name!r}, a {element.tag}, which is not read",
                "Read are IKMarkerTask and IKCoordinateTask.",
            )  # fmt: skip
    if not markers:
        raise FileProblem(path, "applies no marker task", "Set <apply> to true for the markers to follow.")
    try:
        return TaskSet(markers=tuple(markers), coordinates=tuple(coordinates))
    except MareyError as error:
        raise FileProblem(path, f"has tasks that cannot be used ({error})", "Mend them.") from error


def _coordinate(path: Path | str, element: Element, name: str, weight: float) -> CoordinateTask:
    """Read a coordinate's task."""
    source = text(element, "value_type", _VALUES[0])
    if source not in _VALUES:
        raise FileProblem(
            path, f"has the value_type {source!r} in the task {name!r}", f"Write one of {', '.join(_VALUES)}."
        )
    manual = source == "manual_value"
    value = float(numbers(path, element, "value", f"the task {name!r}", np.zeros(1))[0]) if manual else None
    return CoordinateTask(coordinate=name, weight=weight, value=value, from_file=source == "from_file")


def read_task_values(path: Path | str, tasks: TaskSet, model: JointedBody, time: Floats) -> dict[str, Floats]:
    """Read the values of the tasks that take them from a file, at the times of a trial.

    The file is the one that the weights name in `<coordinate_file>`, seen from their folder: a MOT or STO. Between its
    rows values are interpolated linearly.

    Args:
        path: The weights.
        tasks: What was read of them.
        model: Tells angles, which the file may have in degrees, from lengths.
        time: (F,) of the trial [s].

    Returns:
        For each such coordinate (F,) [rad or m]; nothing where no task takes its value from a file.

    Raises:
        FileProblem: The weights name no file, or it has not the coordinate or not the times.
    """
    wanted = [task.coordinate for task in tasks.coordinates if task.from_file]
    if not wanted:
        return {}
    named = read_xml(path, "the weights of OpenSim's inverse kinematics").find(".//coordinate_file")
    place = ((named.text or "") if named is not None else "").strip()
    if not place or place == "Unassigned":
        raise FileProblem(
            path, f"takes the value of {', '.join(wanted)} from a file and names none",
            "Name a MOT in <coordinate_file>, or set <value_type> to manual_value.",
        )  # fmt: skip
    file = Path(path).parent / place
    table = read_table(file)
    missing = [name for name in wanted if name not in table.columns]
    if missing:
        raise FileProblem(file, f"has no column {', '.join(missing)}", f"It has {', '.join(table.columns)}.")
    # A trial and a motion made from it may number the same instants a little differently.
    half = 0.5 * float(np.median(np.diff(table.time))) if len(table.time) > 1 else 0.0
    if time[0] < table.time[0] - half or time[-1] > table.time[-1] + half:
        raise FileProblem(
            file, f"goes from {table.time[0]:g} to {table.time[-1]:g} s, the trial from {time[0]:g} to {time[-1]:g} s",
            "Give values for the whole trial.",
        )  # fmt: skip
    values = {}
    for name in wanted:
        column = np.interp(time, table.time, table.values[:, table.columns.index(name)])
        turns = table.in_degrees and model.coordinates[model.coordinate(name)].rotational
        values[name] = np.radians(column) if turns else column
    return values
