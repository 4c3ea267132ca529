"""knee.html: a knee in motion that turns under the pointer, how near its cartilages come, and the joint's angles."""

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
from marey.view.pages.html import Still, packed, rendered
from marey.view.pages.knee_scene import hex_colour, nearness_codes, part_data, scale_colours, scene_data
from marey.view.pages.problems import readable
from marey.view.pictures.knee_maps import OVERLAP
from marey.view.pictures.knee_picture import DrawnPart

FILES = {
    "knee_motion.npz": "poses, distances, centres of proximity, angles, with standard deviations",
    "proximity.csv": "gap, areas and centres frame by frame",
    "correspondence.json": "how the scanner's bones were joined to the laboratory's",
    "knee.glb": "bones and cartilages in motion, for Blender and the web",
    "knee.mp4": "the same as a video",
    "run.json": "version, settings, inputs, timings",
}
_MEANING = {
    "Gap": "The least distance between the surfaces of two cartilages in a compartment; below zero they overlap, as "
    "deep as it says. Real cartilage gives way by some tenths of a millimetre; an overlap beyond that is an error of "
    "the bones' poses, or of the surfaces.",
    "95 % interval": "1.96 standard deviations of the bones' poses, from the markers in the scanner, the reference "
    "posture and the activity, carried to the gap to first order; femur and tibia count as independent. The surfaces' "
    "own errors are not in it.",
    "Centre of proximity": "The mean of a cartilage's vertices, weighted by their areas and by how far their distances "
    "lie below the limit, carried to the nearest place on the cartilage. It is no centre of pressure.",
    "Area": "Of the cartilage whose distance from the other one is below a limit.",
    "Medial, lateral": "The parts of the tibia's, or of the patella's, cartilage on either side of the bone's middle.",
    "Held": "With the tibia held the other bones move as seen from it; in the room all turn as they did, and the eye "
    "goes along with the knee.",
    "Angles": "After Grood and Suntay, by the anatomical frames of the scanned bones themselves, which are not those "
    "of `marey markers`: constants between the two are no error. Positive are flexion, adduction, inward rotation.",
}
_MOST_NUMBERS = 6_000_000
"""Vertices times frames whose colours the page shows; of longer activities every second, third ... frame."""


@dataclass(frozen=True, eq=False, kw_only=True)
class KneeReport:
    """All that the page tells."""

    title: str
    parts: Mapping[str, DrawnPart]
    """Structures by name."""
    found: KneeMotion
    compared: KneeMotion | None = None
    carried: Sequence[str] = ()
    """Bones that were not measured, and are drawn with the femur where asked for."""
    in_room: bool = False
    """Whether the page begins with nothing held."""
    upright: Floats = field(default_factory=lambda: np.eye(3))
    """(3, 3) turns the room's axes so that Z is up."""
    notes: Sequence[str] = ()
    stills: Sequence[Still] = ()
    timings: Mapping[str, float] = field(default_factory=dict)
    settings: Mapping[str, object] = field(default_factory=dict)
    files: Sequence[str] = ()
    """Names of what stands beside the page."""

    @property
    def both(self) -> tuple[KneeMotion, ...]:
        """What was found, and what it is compared with."""
        return (self.found,) if self.compared is None else (self.found, self.compared)


def write_knee_report(path: Path, report: KneeReport) -> None:
    """Write the page.

    Args:
        path: The HTML file.
        report: What it tells.
    """
    with replacing(path) as beside:
        beside.write_text(knee_html(report), encoding="utf-8")


def knee_html(report: KneeReport) -> str:
    """Give the page's text: one HTML document that loads nothing from elsewhere."""
    motion = report.found.motion
    keys = [(m.method, COLOURS[n]) for n, m in enumerate(report.both)] if report.compared else []
    content = CurvesContent(
        kind="A knee in motion", title=report.title, time=motion.time, tiles=_tiles(report), notes=report.notes,
        tables=[table for table in (_gap_table(report), _difference_table(report)) if table.rows],
        groups=[group for group in _groups(report, keys) if group.plots], stills=report.stills,
        timings=report.timings, settings=report.settings, meaning=_MEANING,
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
    """Give meshes, poses and the codes of distances."""
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
    """Give the legend of the cartilages' colours; None where no joint was measured."""
    if not report.found.joints:
        return None
    ends = "0 mm", f"{report.found.joints[0].limit_mm:g} mm."
    return {"ends": ends, "colours": scale_colours()[::-1], "apart": ["overlap", hex_colour(OVERLAP)]}


def _heading(report: KneeReport) -> float:
    """Give the turn about the vertical [rad] that brings the eye before the knee in the room, as it mostly stands."""
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
    """Give a structure's vertices (V,) that face a joint and their distances (F, V) [mm]; of two joints the nearer.

    Args:
        structure: Its name.
        found: What was measured.
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
        ("skin correction", report.found.method, f"beside {report.compared.method}" if report.compared else ""),
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
            "correction", "compartment", "median mm", "least", "greatest", "its sd", "smaller than its sd", "overlap",
            "near mm²", "centre moves mm",
        ),
        rows=rows, text_columns=(0, 1),
        legend="Over the frames with an answer. Near: area within the limit, the median. The centre of proximity moves "
        "over the tibia: range to the front and back, and from side to side.",
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
        title="What the skin correction does to the gap", head=("compartment", "mean mm", "RMS mm", "most mm"),
        rows=rows, legend=f"{report.compared.method if report.compared else ''} less {report.found.method}.",
    )  # fmt: skip


def _groups(report: KneeReport, keys: Sequence[tuple[str, str]]) -> list[PlotGroup]:
    return [
        PlotGroup(
            title="Gap", keys=keys, wide=True, plots=[*_joint_plots(report, "gap_mm", "gap_sd_mm", "", " mm", 1.0)],
            legend="Least distance of the two cartilages, millimetres over seconds; below zero they overlap. The band "
            "is the 95 % interval of the poses.",
        ),
        PlotGroup(
            title="Area", keys=keys, plots=_joint_plots(report, "near_mm2", None, ", within the limit", " mm²", 50.0),
            legend=f"Of the tibia's or patella's cartilage; proximity.csv has those below {NEAR_MM:g} mm and 0, too.",
        ),
        PlotGroup(
            title="Centre of proximity", keys=keys, plots=_centre_plots(report),
            legend="On the tibia's or patella's cartilage, in the scanner's axes: from the mean place to the back, and "
            "to the left, millimetres.",
        ),
        PlotGroup(
            title="Angles", keys=keys, plots=_angle_plots(report, "angles", "angle_names", 180 / np.pi, "°"),
            legend="Degrees over seconds, by the scanned bones' own anatomical frames.",
        ),
        PlotGroup(
            title="Translations", keys=keys,
            plots=_angle_plots(report, "translations", "translation_names", 1e3, " mm"),
            legend="Of the tibia's origin from the femur's along the joint's axes.",
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
    """Name a compartment, and its joint where there are several."""
    return compartment if len(report.found.joints) == 1 else f"{joint.name}, {compartment}"


def _centre_plots(report: KneeReport) -> list[CurvePlot]:
    plots = []
    for j, joint in enumerate(report.found.joints):
        for c, name in enumerate(joint.compartments):
            for axis, way in ((1, "to the back"), (0, "to the left")):
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
