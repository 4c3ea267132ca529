"""Writing what OpenSim's tools read: markers of a model, tasks of inverse kinematics, and the setups of both tools."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from marey.errors import FileProblem
from marey.io.atomic import replacing
from marey.io.opensim.osim_model import elements_of, with_joints_in_a_set
from marey.markers.kinematics.model_placement import SegmentPoint

IK_ACCURACY = 1e-9
"""Relative accuracy of OpenSim's inverse kinematics. At its default, 1e-5, its angles differ by some hundredths of a
degree from the optimum, at 1e-9 by about 1e-5 degrees (`python -m bench run markers/gait`)."""
CUTOFF_HZ = 6.0
"""Cut-off frequency of the low-pass filter of coordinates before inverse dynamics [Hz], as in the example `Gait2354` of
OpenSim for walking."""


def add_markers(path: Path | str, root: Element, points: Sequence[SegmentPoint]) -> None:
    """Add the points of a person's segments to the markers of a model, in place.

    Args:
        path: The file, for error messages.
        root: The root of the document.
        points: The points on the bodies.

    Raises:
        FileProblem: The model has a marker of the same name.
    """
    model = root if root.tag == "Model" else root.find("Model")
    assert model is not None
    twice = {point.label for point in points} & {e.get("name", "") for e in elements_of(model, "MarkerSet", "Marker")}
    if twice:
        raise FileProblem(path, f"already has the marker {', '.join(sorted(twice))}", "Rename it in the model.")
    markers = model.find("MarkerSet")
    markers = SubElement(model, "MarkerSet", name="markerset") if markers is None else markers
    objects = markers.find("objects")
    objects = SubElement(markers, "objects") if objects is None else objects
    for point in points:
        marker = SubElement(objects, "Marker", name=point.label)
        if with_joints_in_a_set(root):
            SubElement(marker, "socket_parent_frame").text = f"/bodyset/{point.body}"
        else:
            SubElement(marker, "body").text = point.body
        SubElement(marker, "location").text = " ".join(f"{v + 0.0:.12g}" for v in point.place)
        SubElement(marker, "fixed").text = "true"


def ik_task_set(weights: Mapping[str, float], held: Mapping[str, float]) -> Element:
    """Return the tasks of inverse kinematics.

    Args:
        weights: Maps a marker to its weight, relative to the others.
        held: Maps a coordinate that no marker determines to the weight with which it stays at the model's default.
    """
    tasks = Element("IKTaskSet", name="tasks")
    objects = SubElement(tasks, "objects")
    for name, weight in weights.items():
        task = SubElement(objects, "IKMarkerTask", name=name)
        SubElement(task, "apply").text = "true"
        SubElement(task, "weight").text = f"{weight:.6g}"
    for name, weight in held.items():
        task = SubElement(objects, "IKCoordinateTask", name=name)
        SubElement(task, "apply").text = "true"
        SubElement(task, "weight").text = f"{weight:.6g}"
        SubElement(task, "value_type").text = "default_value"
    return tasks


def write_ik_tasks(path: Path | str, tasks: Element) -> None:
    """Write a weights file for OpenSim's inverse kinematics.

    Args:
        path: The file.
        tasks: The tasks, from `ik_task_set`.
    """
    document = Element("OpenSimDocument", Version="40000")
    document.append(tasks)
    _write(path, document)


def write_ik_setup(
    path: Path | str, *, model: str, markers: str, tasks: Element, span: tuple[float, float], out: str
) -> None:
    """Write the setup of OpenSim's inverse kinematics tool, to be run in the folder of the files.

    Args:
        path: The file.
        model: Name of the model.
        markers: Name of the TRC.
        tasks: The tasks.
        span: First and last time [s].
        out: Name of the MOT that the tool writes.
    """
    document = Element("OpenSimDocument", Version="40000")
    tool = SubElement(document, "InverseKinematicsTool", name="inverse_kinematics")
    for tag, value in (
        ("results_directory", "."), ("model_file", model), ("constraint_weight", "Inf"),
        ("accuracy", f"{IK_ACCURACY:g}"), ("time_range", _span(span)), ("output_motion_file", out),
        ("report_errors", "true"), ("marker_file", markers),
    ):  # fmt: skip
        SubElement(tool, tag).text = value
    tool.append(tasks)
    _write(path, document)


def write_id_setup(
    path: Path | str, *, model: str, coordinates: str, loads: str, span: tuple[float, float], out: str
) -> None:
    """Write the setup of OpenSim's inverse dynamics tool, to be run in the folder of the files.

    Args:
        path: The file.
        model: Name of the model.
        coordinates: Name of the MOT with the coordinates.
        loads: Name of the file of external loads; empty for none.
        span: First and last time [s].
        out: Name of the STO that the tool writes.
    """
    document = Element("OpenSimDocument", Version="40000")
    tool = SubElement(document, "InverseDynamicsTool", name="inverse_dynamics")
    for tag, value in (
        ("results_directory", "."), ("model_file", model), ("time_range", _span(span)),
        ("forces_to_exclude", "Muscles"), ("external_loads_file", loads), ("coordinates_file", coordinates),
        ("lowpass_cutoff_frequency_for_coordinates", f"{CUTOFF_HZ:g}"), ("output_gen_force_file", out),
    ):  # fmt: skip
        SubElement(tool, tag).text = value
    _write(path, document)


def _span(span: tuple[float, float]) -> str:
    return f"{span[0]:.6f} {span[1]:.6f}"


def _write(path: Path | str, document: Element) -> None:
    ElementTree.indent(document)
    with replacing(path) as temporary:
        ElementTree.ElementTree(document).write(temporary, encoding="UTF-8", xml_declaration=True)
