"""Reading the tasks of OpenSim's inverse kinematics (IKTaskSet): weights of markers and of coordinates."""

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from marey.errors import FileProblem, MareyError
from marey.io.osim_functions import numbers, read_xml, text, truth
from marey.markers.tasks import CoordinateTask, MarkerTask, TaskSet

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
