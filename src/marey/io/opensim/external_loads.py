"""Writing ground reaction forces for OpenSim: a MOT with forces, points and moments, and the ExternalLoads."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from marey.arrays import Floats
from marey.io.atomic import replacing
from marey.io.axes import OPENSIM_FROM_WORLD
from marey.io.opensim.mot_sto import TimeSeriesTable, write_table
from marey.markers.preprocessing.foot_loads import FootLoad

FORCES, EXTERNAL_LOADS = "grf.mot", "external_loads.xml"
"""Names of the files with the forces, and with the bodies on which they act."""


def write_forces(path: Path | str, loads: Sequence[FootLoad], *, start_s: float, world_from_laboratory: Floats) -> None:
    """Write `grf.mot`: per foot and plate force [N], point [m] and free moment [N m], in OpenSim's axes (Y up).

    Args:
        path: The file.
        loads: Loads of plates with one rate.
        start_s: Time of the first sample [s].
        world_from_laboratory: (3, 3) rotation from the laboratory to the world (Z up).
    """
    turn = OPENSIM_FROM_WORLD @ world_from_laboratory
    columns: list[str] = []
    values = []
    for load in loads:
        for part, of in (("v", load.force), ("p", load.point), ("torque_", load.moment)):
            columns += [f"{load_name(load)}_{part}{axis}" for axis in "xyz"]
            values.append(of @ turn.T)
    time = start_s + np.arange(len(loads[0].force)) / loads[0].rate
    table = TimeSeriesTable(
        name="ground reaction forces", columns=tuple(columns), time=time, values=np.concatenate(values, 1),
        in_degrees=False,
    )  # fmt: skip
    write_table(path, table)


def write_external_loads(
    path: Path | str, loads: Sequence[FootLoad], bodies: Mapping[str, str], *, data: str = FORCES
) -> None:
    """Write `external_loads.xml`, which applies the forces of a MOT to the feet of a model.

    Args:
        path: The file.
        loads: The loads in the MOT.
        bodies: Maps `left` and `right` to the body of the model on which the force acts.
        data: Name of the MOT beside the file.
    """
    document = Element("OpenSimDocument", Version="40000")
    whole = SubElement(document, "ExternalLoads", name="ground_reaction_forces")
    objects = SubElement(whole, "objects")
    for load in loads:
        force = SubElement(objects, "ExternalForce", name=load_name(load))
        for tag, value in (
            ("appliesForce", "true"), ("applied_to_body", bodies[load.side]), ("force_expressed_in_body", "ground"),
            ("point_expressed_in_body", "ground"), ("force_identifier", f"{load_name(load)}_v"),
            ("point_identifier", f"{load_name(load)}_p"), ("torque_identifier", f"{load_name(load)}_torque_"),
            ("data_source_name", data),
        ):  # fmt: skip
            SubElement(force, tag).text = value
    SubElement(whole, "groups")
    SubElement(whole, "datafile").text = data
    ElementTree.indent(document)
    with replacing(path) as temporary:
        ElementTree.ElementTree(document).write(temporary, encoding="UTF-8", xml_declaration=True)


def load_name(load: FootLoad) -> str:
    """Return the name of a load in both files, such as `force_plate_1_left`."""
    return f"{load.plate}_{load.side}"
