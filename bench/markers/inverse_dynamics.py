"""Residuals of OpenSim's inverse dynamics from exported files, beside OpenSim's own scaling and kinematics.

The walk `functional/walk.c3d` over three force plates, of a person of 60 kg (stated in the file), with markers from
pelvis to feet and none on the trunk. The model is `gait/model_scaled.osim`, scaled anew to this person. Ours: bones
from `marey markers` (joint centres are the hip, knee and ankle that the file itself contains), then `marey export --to
opensim`. OpenSim's: its scaling tool with measurements between skin markers and the placement of all markers in the
static trial, then its inverse kinematics on the skin markers, all with one weight. Inverse dynamics is OpenSim's for
both, with the same forces, filter and time. The residuals are forces and moments at the pelvis that nothing explains.
Each way is measured with both assumptions on the trunk, which nothing measures: upright, as the export assumes, and at
its default on the pelvis, as OpenSim's inverse kinematics leaves it.
"""

import argparse
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

import marey
from bench.declaration import Bench
from bench.recording import Column, Run, Table
from marey.io.markers.readers import read_markers
from marey.io.opensim.mot_sto import read_table
from marey.io.opensim.tool_setups import ik_task_set, write_ik_setup
from marey.io.opensim.trc import PointPaths, read_trc, write_trc

BENCH = Bench(
    measures="Residuals of OpenSim's inverse dynamics from exported files, beside OpenSim's scaling and kinematics.",
    sources=("src/marey/pipelines/exchange", "src/marey/io/opensim", "src/marey/markers"),
    minutes=3,
)
MASS_KG = 60.0
"""PROCESSING:Bodymass of the walk [kg]."""
SIDES = (("L", "left", "l"), ("R", "right", "r"))
TRUNK = ("lumbar_extension", "lumbar_bending", "lumbar_rotation")
"""Coordinates of the trunk on the pelvis in the model."""
HELD = (*TRUNK, "mtp_angle_r", "mtp_angle_l")
"""Coordinates that no skin marker determines."""
SETUP = """
[segments]
pelvis = ["LASI", "RASI", "LPSI", "RPSI"]
left_thigh = ["LF01", "LF02", "LF03", "LF04", "LF05", "LTHI"]
right_thigh = ["RF01", "RF02", "RF03", "RF04", "RF05", "RTHI"]
left_shank = ["LT01", "LT02", "LT03", "LT04", "LT05", "LTIB"]
right_shank = ["RT01", "RT02", "RT03", "RT04", "RT05", "RTIB"]
left_foot = ["LANK", "LHEE", "LTOE"]
right_foot = ["RANK", "RHEE", "RTOE"]

[landmarks]
LASIS = "LASI"
RASIS = "RASI"
LPSIS = "LPSI"
RPSIS = "RPSI"
left_HJC = "LFEP"
right_HJC = "RFEP"
left_KJC = "LFEO"
right_KJC = "RFEO"
left_AJC = "LTIO"
right_AJC = "RTIO"
left_LE = "LKNE"
right_LE = "RKNE"
left_LM = "LANK"
right_LM = "RANK"
"""
"""Segments and landmarks of the person. The hip, knee and ankle are points that the file's own program computed."""
MEASURED = {
    "pelvis": ("RASI", "LASI"), "femur": ("ASI", "KNE"), "tibia": ("KNE", "ANK"), "talus": ("HEE", "TOE"),
    "calcn": ("HEE", "TOE"), "toes": ("HEE", "TOE"),
}  # fmt: skip
"""Skin markers between which OpenSim measures a body, as in the measurements of its example `Gait2354`; it has no
measurement of the trunk here."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--method", default="skin", help="method of `marey markers` whose bones are exported")


def run(run: Run) -> None:
    """Scale, follow, and compute the residuals in both ways."""
    table = run.table(
        "Residuals at the pelvis",
        ("scaling and kinematics", "trunk"),
        Column("force along x", "N", 1),
        Column("along y (up)", "N", 1),
        Column("along z (walking)", "N", 1),
        Column("moment tilt", "N m", 1),
        Column("list", "N m", 1),
        Column("rotation", "N m", 1),
        Column("force, norm", "N", 1),
        Column("moment, norm", "N m", 1),
        note="Root mean squares over the time in which every standing foot is on a plate, 5.16 to 6.64 s.",
    )
    try:
        import opensim
    except ImportError:
        table.note = "OpenSim is not installed here."
        return
    opensim.Logger.setLevelString("off")
    data = run.shared / "data" / "markers"
    exported = export(data, run.out / "inverse_dynamics", run.arguments.method)
    name = f"marey export ({run.arguments.method})"
    row(opensim, table, (name, "upright"), exported, "ik_setup.xml")
    without_trunk(exported)
    row(opensim, table, (name, "as the pelvis"), exported, "ik_trunk_setup.xml")
    own = of_opensim(opensim, data, exported, run.out / "opensim")
    row(opensim, table, ("OpenSim", "upright"), own, "ik_setup.xml")
    row(opensim, table, ("OpenSim", "as the pelvis"), own, "ik_trunk_setup.xml")


def export(data: Path, folder: Path, method: str) -> Path:
    """Estimate the bones of the walk, and export them with the model."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "person.toml").write_text(SETUP)
    progress = marey.RecordingProgress()
    trial = marey.open_markers(
        data / "functional" / "walk.c3d", clusters=folder / "person.toml", static=data / "functional" / "static.c3d",
        progress=progress,
    )  # fmt: skip
    marey.estimate_bones(trial, [method], progress=progress).save(folder / "walk")
    return marey.export(
        folder / "walk", out=folder / "exported", to="opensim", model=data / "gait" / "model_scaled.osim",
        mass_kg=MASS_KG, progress=progress,
    ).parent  # fmt: skip


@contextmanager
def inside(folder: Path) -> Iterator[None]:
    """Work in a folder, to which the files of a setup are relative."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def row(opensim: ModuleType, table: Table, labels: tuple[str, str], folder: Path, setup: str) -> None:
    """Run inverse kinematics and dynamics in a folder, and add the residuals."""
    with inside(folder):
        if not opensim.InverseKinematicsTool(setup).run() or not opensim.InverseDynamicsTool("id_setup.xml").run():
            raise RuntimeError(f"OpenSim could not run {setup} in {folder}.")
    found = read_table(folder / "id.sto")
    columns = dict(zip(found.columns, found.values.T, strict=True))
    forces = [columns[f"pelvis_t{axis}_force"] for axis in "xyz"]
    moments = [columns[f"pelvis_{name}_moment"] for name in ("tilt", "list", "rotation")]
    norms = [np.sqrt((np.square(each)).sum(0)) for each in (forces, moments)]
    table.row(labels, *(float(np.sqrt(np.mean(v**2))) for v in (*forces, *moments, *norms)))


def without_trunk(folder: Path) -> None:
    """Write a second setup of inverse kinematics, in which the trunk is held at its default on the pelvis."""
    document = ElementTree.parse(folder / "ik_setup.xml")
    objects = document.find(".//IKTaskSet/objects")
    assert objects is not None
    for task in list(objects):
        if task.get("name", "").startswith("thorax_"):
            objects.remove(task)
    for task in ik_task_set({}, dict.fromkeys(TRUNK, 1.0)).find("objects") or ():
        objects.append(task)
    document.write(folder / "ik_trunk_setup.xml")


def of_opensim(opensim: ModuleType, data: Path, exported: Path, folder: Path) -> Path:
    """Scale the model with OpenSim's tool, and set up its inverse kinematics on the skin markers."""
    folder.mkdir(parents=True, exist_ok=True)
    labels = skin_labels()
    write_skin(folder / "static.trc", data / "functional" / "static.c3d", labels, mean=True)
    write_marked_model(data / "gait" / "model_scaled.osim", folder / "model.osim")
    (folder / "scale_setup.xml").write_text(scale_setup(labels))
    with inside(folder):
        if not opensim.ScaleTool("scale_setup.xml").run():
            raise RuntimeError("OpenSim could not scale the model.")
    points = read_trc(exported / "points.trc")
    trunk = [n for n, name in enumerate(points.names) if name.startswith("thorax_")]
    walk = write_skin(folder / "points.trc", data / "functional" / "walk.c3d", labels, more=points, chosen=trunk)
    add_trunk(folder / "placed.osim", folder / "scaled.osim")
    weights = dict.fromkeys(labels, 1.0)
    upright = ik_task_set(
        weights | {points.names[n]: 0.01 for n in trunk}, dict.fromkeys(HELD[len(TRUNK) :], 1.0)
    )  # fmt: skip
    held, span = ik_task_set(weights, dict.fromkeys(HELD, 1.0)), (float(walk[0]), float(walk[-1]))
    for name, tasks in (("ik_setup.xml", upright), ("ik_trunk_setup.xml", held)):
        write_ik_setup(
            folder / name, model="scaled.osim", markers="points.trc", tasks=tasks, span=span, out="ik.mot"
        )  # fmt: skip
    for name in ("id_setup.xml", "external_loads.xml", "grf.mot"):
        (folder / name).write_text((exported / name).read_text())
    return folder


def skin_labels() -> list[str]:
    """Labels of the skin markers that both ways use."""
    each = ("ASI", "PSI", "THI", "KNE", "TIB", "ANK", "HEE", "TOE")
    clusters = [f"{side}{part}0{n}" for side in "LR" for part in "FT" for n in range(1, 6)]
    return [f"{side}{name}" for side in "LR" for name in each] + clusters


def write_skin(
    path: Path, trial: Path, labels: list[str], *, mean: bool = False, more: PointPaths | None = None,
    chosen: list[int] | None = None,
) -> np.ndarray:  # fmt: skip
    """Write skin markers as a TRC: the mean over a trial, twice, or every frame with some other points."""
    read = read_markers(trial)
    points, time, names = read.select(labels).points, read.time, tuple(labels)
    if mean:
        points, time = np.repeat(np.nanmean(points, 0)[None], 2, 0), time[:2]
    if more is not None and chosen is not None:
        assert np.allclose(time, more.time, atol=1e-5)
        points = np.concatenate([points, more.points[:, chosen]], 1)
        names = (*names, *(more.names[n] for n in chosen))
    write_trc(path, PointPaths(names=names, time=time, rate=read.rate, points=points))
    return time


def write_marked_model(source: Path, path: Path) -> None:
    """Give the model the skin markers of the walk, where its own or the usual places are; the placement moves them."""
    document = ElementTree.parse(source)
    markers = document.find(".//MarkerSet/objects")
    assert markers is not None
    own = {m.get("name"): np.array([float(v) for v in (m.findtext("location") or "").split()]) for m in markers}
    for marker in list(markers):
        markers.remove(marker)
    for first, _, last in SIDES:
        sign = 1 if first == "R" else -1
        sacrum = own["V.Sacral"] + [0, 0, sign * 0.04]
        places = {
            f"{first}ASI": ("pelvis", own[f"{first}.ASIS"]), f"{first}PSI": ("pelvis", sacrum),
            f"{first}THI": (f"femur_{last}", own[f"{first}.Thigh.Front"]),
            f"{first}KNE": (f"femur_{last}", own[f"{first}.Knee.Lat"]),
            f"{first}TIB": (f"tibia_{last}", own[f"{first}.Shank.Front"]),
            f"{first}ANK": (f"tibia_{last}", own[f"{first}.Ankle.Lat"]),
            f"{first}HEE": (f"calcn_{last}", own[f"{first}.Heel"]),
            f"{first}TOE": (f"calcn_{last}", (own[f"{first}.Toe.Lat"] + own[f"{first}.Toe.Med"]) / 2),
            **{f"{first}F0{n}": (f"femur_{last}", own[f"{first}.Thigh.Front"]) for n in range(1, 6)},
            **{f"{first}T0{n}": (f"tibia_{last}", own[f"{first}.Shank.Front"]) for n in range(1, 6)},
        }  # fmt: skip
        for label, (body, place) in places.items():
            _add_marker(markers, label, body, place)
    document.write(path)


def _add_marker(markers: Element, label: str, body: str, place: np.ndarray) -> None:
    marker = SubElement(markers, "Marker", name=label)
    SubElement(marker, "body").text = body
    SubElement(marker, "location").text = " ".join(map(str, place))
    SubElement(marker, "fixed").text = "false"


def scale_setup(labels: list[str]) -> str:
    """Return the setup of OpenSim's scaling tool: measurements, mass, and the placement in the static trial."""
    measurements = "".join(
        f"<Measurement name='{body}{side}'><apply>true</apply><MarkerPairSet><objects>{pairs}</objects></MarkerPairSet>"
        f"<BodyScaleSet><objects><BodyScale name='{body}{side}'><axes>X Y Z</axes></BodyScale></objects></BodyScaleSet>"
        "</Measurement>"
        for body, side, pairs in _measurements()
    )
    placed = [label for label in labels if label[1:] in ("ASI", "PSI", "KNE", "ANK", "HEE", "TOE")]
    tasks = ElementTree.tostring(ik_task_set(dict.fromkeys(placed, 1.0), dict.fromkeys(HELD, 1.0)), "unicode")
    return (
        f"<OpenSimDocument Version='40000'><ScaleTool name='person'><mass>{MASS_KG}</mass><GenericModelMaker>"
        "<model_file>model.osim</model_file></GenericModelMaker><ModelScaler><apply>true</apply>"
        f"<scaling_order>measurements</scaling_order><MeasurementSet><objects>{measurements}</objects></MeasurementSet>"
        "<marker_file>static.trc</marker_file><time_range>-1e9 1e9</time_range>"
        "<preserve_mass_distribution>true</preserve_mass_distribution><output_model_file>only_scaled.osim"
        f"</output_model_file></ModelScaler><MarkerPlacer><apply>true</apply>{tasks}<marker_file>static.trc"
        "</marker_file><time_range>-1e9 1e9</time_range><output_model_file>placed.osim</output_model_file>"
        "<max_marker_movement>-1</max_marker_movement></MarkerPlacer></ScaleTool></OpenSimDocument>"
    )


def _measurements() -> Iterator[tuple[str, str, str]]:
    """Yield body, its side, and the pairs of markers."""
    for body, (one, other) in MEASURED.items():
        if body == "pelvis":
            yield body, "", f"<MarkerPair><markers>{one} {other}</markers></MarkerPair>"
            continue
        for first, _, last in SIDES:
            yield body, f"_{last}", f"<MarkerPair><markers>{first}{one} {first}{other}</markers></MarkerPair>"


def add_trunk(source: Path, path: Path) -> None:
    """Add the points of an upright trunk to a model: its joint, and 0.1 m along each axis of the body."""
    document = ElementTree.parse(source)
    markers = document.find(".//MarkerSet/objects")
    assert markers is not None
    for ending, place in zip("oxyz", np.vstack([np.zeros(3), 0.1 * np.eye(3)]), strict=True):
        marker = SubElement(markers, "Marker", name=f"thorax_{ending}")
        SubElement(marker, "socket_parent_frame").text = "/bodyset/torso"
        SubElement(marker, "location").text = " ".join(map(str, place))
        SubElement(marker, "fixed").text = "true"
    document.write(path)
