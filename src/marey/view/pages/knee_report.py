"""knee.html: a knee in motion in 3-D, the proximity of its cartilages, and the angles of the joint."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from marey.arrays import Floats, Integers
from marey.geometry import rotations
from marey.io.atomic import replacing
from marey.knee.motion.joint_motion import BASE, KneeMotion
from marey.knee.motion.proximity import NEAR_MM, Proximity
from marey.view.pages.curves import (
    COLOURS,
    CurvePlot,
    CurvesContent,
    NumberTable,
    PlotGroup,
    Trace,
    curves_data,
    stride_of,
)
from marey.view.pages.html import PageHead, Still, packed, rendered
from marey.view.pages.knee_scene import hex_colour, nearness_codes, part_data, scale_colours, scene_data
from marey.view.pages.problems import readable
from marey.view.pictures.knee_maps import OVERLAP
from marey.view.pictures.knee_picture import DrawnPart

FILES = {
    "knee_motion.npz": "poses, distances, centres of proximity, angles, with standard deviations",
    "proximity.csv": "gap, areas and centres, one row per frame",
    "correspondence.json": "transforms between the bones of the scanner and those of the laboratory",
    "knee.glb": "bones and cartilages in motion, for Blender and the web",
    "knee.mp4": "the same motion as a video",
    "run.json": "version, settings, inputs, timings",
}
"""Files beside the page and their content."""
_MEANING = {
    "Gap": "The smallest distance between the surfaces of two cartilages in a compartment. A negative value is the "
    "depth of an overlap. Real cartilage deforms by less than a millimetre; a larger overlap is an error of the "
    "poses of the bones or of the surfaces.",
    "95 % interval": "1.96 standard deviations of the poses of the bones, from the markers in the scanner, the "
    "reference posture and the activity, propagated to the gap to first order with independent errors of femur and "
    "tibia. Errors of the surfaces are not included.",
    "Centre of proximity": "The mean of the vertices of a cartilage, weighted by area and by the difference between "
    "the limit and their distance, projected to the nearest point of the cartilage. It is not a centre of pressure.",
    "Area": "Area of the part of a cartilage whose distance from the other cartilage is below a limit.",
    "Medial, lateral": "The parts of the cartilage of the tibia or patella on either side of the middle of the bone.",
    "Fixed": "With the tibia fixed, the other bones move relative to it. In the room, all bones move as measured, and "
    "the view follows the knee.",
    "Angles": "Defined after Grood and Suntay in the anatomical frames of the scanned bones. These differ from the "
    "frames of `marey markers`, so constant differences are not errors. Positive are flexion, adduction, internal "
    "rotation.",
}
"""Explanations of the terms on the page."""
_MOST_NUMBERS = 6_000_000
"""Number of vertices times frames in the page at most; longer activities are subsampled. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class KneeReport:
    """Content of the page of a moving knee."""

    title: str
    parts: Mapping[str, DrawnPart]
    """Structures by name."""
    found: KneeMotion
    compared: KneeMotion | None = None
    carried: Sequence[str] = ()
    """Bones that were not measured; they can be drawn with the femur."""
    in_room: bool = False
    """Whether the page starts with no bone fixed."""
    upright: Floats = field(default_factory=lambda: np.eye(3))
    """(3, 3) rotation of the axes of the room that makes Z the vertical."""
    notes: Sequence[str] = ()
    stills: Sequence[Still] = ()
    timings: Mapping[str, float] = field(default_factory=dict)
    settings: Mapping[str, object] = field(default_factory=dict)
    files: Sequence[str] = ()
    """Names of the files beside the page."""
    head: PageHead = field(default_factory=PageHead)

    @property
    def both(self) -> tuple[KneeMotion, ...]:
        """The motion and, if any, the motion it is compared with."""
        return (self.found,) if self.compared is None else (self.found, self.compared)


def write_knee_report(path: Path, report: KneeReport) -> None:
    """Write the page.

    Args:
        path: The HTML file.
        report: The content of the page.
    """
    with replacing(path) as beside:
        beside.write_text(knee_html(report), encoding="utf-8")


def knee_html(report: KneeReport) -> str:
    """Return the page as one HTML document that loads nothing from elsewhere."""
    motion = report.found.motion
    keys = [(m.method, COLOURS[n]) for n, m in enumerate(report.both)] if report.compared else []
    content = CurvesContent(
        kind="A knee in motion", title=report.title, time=motion.time, tiles=_tiles(report), notes=report.notes,
        tables=[table for table in (_gap_table(report), _difference_table(report)) if table.rows],
        groups=[group for group in _groups(report, keys) if group.plots], stills=report.stills,
        timings=report.timings, settings=report.settings, meaning=_MEANING, head=report.head,
        files={name: what for name, what in FILES.items() if name in (*report.files, "run.json")},
    )  # fmt: skip
    vertices = sum(m.shape[1] for joint in report.found.joints for m in (joint.base_distance_mm,)) or 1
    vertices += sum(joint.moving_distance_mm.shape[1] for joint in report.found.joints)
    frames = len(motion)
    stride = max(stride_of(frames), -(-frames * vertices * len(report.both) // _MOST_NUMBERS))
    rate = (frames - 1) / float(motion.time[-1] - motion.time[0]) if frames > 1 else 1.0
    data = curves_data(content, stride) | {
        "rate": rate, "stride": stride, "frames": frames, "knee": _scene(report, stride),
    }  # fmt: skip
    legend = "Dots and lines: centres of proximity and their paths."
    return rendered("knee.html", content, data=data, replay_legend=legend)


def _scene(report: KneeReport, stride: int) -> dict[str, object]:
    """Return meshes, poses and coded distances."""
    motion, held = report.found.motion, BASE in report.found.motion.poses
    answered = motion.answered(BASE if held else motion.bones[0])[::stride]
    return {
        **scene_data(report.parts, left=motion.left), "scale": _scale(report),
        "parts": [_part(name, part, report, stride) for name, part in report.parts.items()],
        "motions": [_motion(each, report, stride) for each in report.both],
        "carried": dict.fromkeys(report.carried, "femur"), "held": "room" if report.in_room or not held else "tibia",
        "room": held, "heading": _heading(report), "first": int(np.argmax(answered)),
    }  # fmt: skip


def _scale(report: KneeReport) -> dict[str, object] | None:
    """Return the legend of the colours of cartilage, or None if no joint was measured."""
    if not report.found.joints:
        return None
    ends = "0 mm", f"{report.found.joints[0].limit_mm:g} mm."
    return {"ends": ends, "colours": scale_colours()[::-1], "apart": ["overlap", hex_colour(OVERLAP)]}


def _heading(report: KneeReport) -> float:
    """Return the rotation about the vertical [rad] that shows the knee from the front in its mean orientation."""
    motion = report.found.motion
    turns = motion.poses[BASE if BASE in motion.poses else motion.bones[0]].rotation
    known = turns[np.isfinite(turns).all((1, 2))]
    if not len(known):
        return 0.0
    front = report.upright @ rotations.mean(known) @ np.array([0.0, -1.0, 0.0])
    return float(np.arctan2(front[0], -front[1]))


def _part(name: str, part: DrawnPart, report: KneeReport, stride: int) -> dict[str, object]:
    sources, maps = None, []
    for each in report.both:
        found = distances_of(name, each)
        maps.append(
            None if found is None else packed(nearness_codes(found[1][::stride], each.joints[0].limit_mm), "u1")
        )
        sources = sources if found is None else packed(found[0], "u4")
    shown = part.bone not in report.carried
    return part_data(name, part, switch=part.bone, shown=shown) | {"sources": sources, "maps": maps}


def distances_of(structure: str, found: KneeMotion) -> tuple[Integers, Floats] | None:
    """Return the vertices (V,) of a structure that face a joint, and their distances (F, V) [mm], the smaller of two.

    Args:
        structure: Name of the structure.
        found: The measured motion.
    """
    maps = [
        (side.sources, distance)
        for joint in found.joints
        for side, distance in ((joint.base, joint.base_distance_mm), (joint.moving, joint.moving_distance_mm))
        if side.name == structure
    ]
    if not maps:
        return None
    return maps[0][0], np.asarray(np.fmin.reduce([distance for _, distance in maps]))


def _motion(found: KneeMotion, report: KneeReport, stride: int) -> dict[str, object]:
    poses = {}
    for bone, pose in found.motion.poses.items():
        matrix = np.concatenate([report.upright @ pose.rotation, (pose.translation @ report.upright.T)[:, :, None]], 2)
        poses[bone] = packed(matrix[::stride].reshape(-1, 12), "f4")
    paths = [
        {"bone": bone, "places": packed(places[::stride, c], "f4")}
        for joint in found.joints
        for bone, places in (("tibia" if joint.name == "tibiofemoral" else "patella", joint.centre_mm),)
        for c in range(len(joint.compartments))
    ]
    return {"label": found.method, "poses": poses, "paths": paths}


def _tiles(report: KneeReport) -> list[tuple[str, str, str]]:
    motion = report.found.motion
    both = np.all([motion.answered(bone) for bone in motion.bones], axis=0)
    duration = float(motion.time[-1] - motion.time[0])
    side = {None: "side unknown", True: "left knee", False: "right knee"}[motion.left]
    tiles = [
        ("frames with all bones", f"{int(both.sum())} of {len(motion)}", ", ".join(motion.bones)),
        ("duration", f"{duration:.2f} s", side),
        ("skin correction", report.found.method, f"compared with {report.compared.method}" if report.compared else ""),
    ]
    for joint in report.found.joints:
        for c, name in enumerate(joint.compartments):
            gap = joint.gap_mm[:, c][np.isfinite(joint.gap_mm[:, c])]
            sd = joint.gap_sd_mm[:, c][np.isfinite(joint.gap_sd_mm[:, c])]
            if len(gap):
                within = f"± {1.96 * np.median(sd):.1f} mm, " if len(sd) else ""
                words = f"median gap, {within}from {gap.min():.1f} to {gap.max():.1f}"
                tiles.append((f"{joint.name}, {name}", f"{np.median(gap):.1f} mm".replace("-", "−"), words))
    return tiles


def _gap_table(report: KneeReport) -> NumberTable:
    rows = []
    for found in report.both:
        for joint in found.joints:
            for c, name in enumerate(joint.compartments):
                known = np.isfinite(joint.gap_mm[:, c])
                if known.any():
                    gap, sure = joint.gap_mm[known, c], np.isfinite(joint.gap_sd_mm[known, c])
                    sd = f"{np.median(joint.gap_sd_mm[known, c][sure]):.2f}" if sure.any() else ""
                    unsure = f"{100 * joint.unsure[known, c].mean():.0f} %" if sure.any() else ""
                    rows.append(
                        [
                            found.method, f"{joint.name}, {name}", f"{np.median(gap):.2f}", f"{gap.min():.2f}",
                            f"{gap.max():.2f}", sd, unsure, f"{100 * (gap < 0).mean():.0f} %",
                            f"{np.median(joint.near_mm2[known, c]):.0f}", _way(joint.centre_mm[:, c]),
                        ]
                    )  # fmt: skip
    return NumberTable(
        title="Gaps",
        head=(
            "correction", "compartment", "median mm", "minimum mm", "maximum mm", "sd mm", "below its sd", "overlap",
            "near mm²", "path of centre mm",
        ),
        rows=rows, text_columns=(0, 1),
        legend="Over the frames with a result. Below its sd: share of frames whose gap is smaller than its standard "
        "deviation. Near: median area within the limit. Path of centre: range of the centre of proximity, "
        "anterior-posterior and medial-lateral.",
    )  # fmt: skip


def _way(centre: Floats) -> str:
    known = centre[np.isfinite(centre).all(1)]
    if not len(known):
        return ""
    reach = known.max(0) - known.min(0)
    return f"{reach[1]:.1f} × {reach[0]:.1f}"


def _difference_table(report: KneeReport) -> NumberTable:
    rows = []
    if report.compared is not None:
        for one, other in zip(report.found.joints, report.compared.joints, strict=False):
            for c, name in enumerate(one.compartments):
                between = other.gap_mm[:, c] - one.gap_mm[:, c]
                between = between[np.isfinite(between)]
                if len(between):
                    root = np.sqrt(np.mean(between**2))
                    text = f"{between.mean():+.2f}".replace("-", "−")
                    rows.append([f"{one.name}, {name}", text, f"{root:.2f}", f"{np.abs(between).max():.2f}"])
    return NumberTable(
        title="Effect of the skin correction on the gap", head=("compartment", "mean mm", "RMS mm", "largest mm"),
        rows=rows, legend=f"{report.compared.method if report.compared else ''} minus {report.found.method}.",
    )  # fmt: skip


def _groups(report: KneeReport, keys: Sequence[tuple[str, str]]) -> list[PlotGroup]:
    return [
        PlotGroup(
            title="Gap", keys=keys, wide=True, plots=[*_joint_plots(report, "gap_mm", "gap_sd_mm", "", " mm", 1.0)],
            legend="Smallest distance between the two cartilages [mm] over time [s]; negative values are overlaps. "
            "The band is the 95 % interval due to the poses.",
        ),
        PlotGroup(
            title="Area", keys=keys, plots=_joint_plots(report, "near_mm2", None, ", within the limit", " mm²", 50.0),
            legend="Area of the cartilage of tibia or patella; proximity.csv also contains the areas below "
            f"{NEAR_MM:g} mm and 0.",
        ),
        PlotGroup(
            title="Centre of proximity", keys=keys, plots=_centre_plots(report),
            legend="On the cartilage of tibia or patella in the axes of the scanner: posterior and left "
            "of the mean position [mm].",
        ),
        PlotGroup(
            title="Angles", keys=keys, plots=_angle_plots(report, "angles", "angle_names", 180 / np.pi, "°"),
            legend="Degrees over time [s], in the anatomical frames of the scanned bones.",
        ),
        PlotGroup(
            title="Translations", keys=keys,
            plots=_angle_plots(report, "translations", "translation_names", 1e3, " mm"),
            legend="Position of the origin of the tibia relative to that of the femur along the axes of the joint.",
        ),
    ]  # fmt: skip


def _joint_plots(
    report: KneeReport, what: str, spread: str | None, title: str, unit: str, least: float
) -> list[CurvePlot]:  # fmt: skip
    plots = []
    for j, joint in enumerate(report.found.joints):
        for c, name in enumerate(joint.compartments):
            curves = [
                Trace(
                    label=each.method, colour=COLOURS[n], values=getattr(each.joints[j], what)[:, c],
                    sd=getattr(each.joints[j], spread)[:, c] if spread is not None and n == 0 else None,
                )
                for n, each in enumerate(report.both) if j < len(each.joints)
            ]  # fmt: skip
            plots.append(CurvePlot(title=f"{joint.name}, {name}: {title}", curves=curves[::-1], unit=unit, least=least))
    return plots


def _part_name(report: KneeReport, joint: Proximity, compartment: str) -> str:
    """Return the name of a compartment, with its joint if there are several."""
    return compartment if len(report.found.joints) == 1 else f"{joint.name}, {compartment}"


def _centre_plots(report: KneeReport) -> list[CurvePlot]:
    plots = []
    for j, joint in enumerate(report.found.joints):
        for c, name in enumerate(joint.compartments):
            for axis, way in ((1, "posterior"), (0, "left")):
                curves = [
                    _centre_curve(each.joints[j], each.method, c, axis, n)
                    for n, each in enumerate(report.both)
                    if j < len(each.joints)
                ]
                if any(np.isfinite(curve.values).any() for curve in curves):
                    title = f"{_part_name(report, joint, name)}, {way}"
                    plots.append(CurvePlot(title=title, curves=curves[::-1], unit=" mm", least=4.0))
    return plots


def _centre_curve(joint: Proximity, label: str, c: int, axis: int, n: int) -> Trace:
    values = joint.centre_mm[:, c, axis]
    known = np.isfinite(values)
    middle = values[known].mean() if known.any() else 0.0
    sd = joint.centre_sd_mm[:, c, axis] if n == 0 else None
    return Trace(label=label, colour=COLOURS[n], values=values - middle, sd=sd)


def _angle_plots(report: KneeReport, what: str, names: str, scale: float, unit: str) -> list[CurvePlot]:
    if report.found.angles is None:
        return []
    plots = []
    for k, name in enumerate(getattr(report.found.angles, names)):
        curves = [
            Trace(
                label=each.method, colour=COLOURS[n], values=scale * getattr(each.angles, what)[:, k],
                sd=scale * getattr(each.angles, f"{what}_sd")[:, k] if n == 0 else None,
            )
            for n, each in enumerate(report.both) if each.angles is not None
        ]  # fmt: skip
        plots.append(CurvePlot(title=readable(name), curves=curves[::-1], unit=unit))
    return plots
