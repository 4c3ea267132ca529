"""The capture report: one HTML file with curves, replay, images and problems, which needs no network."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats, Mask
from marey.body.articulation.surface import Body
from marey.cameras import lens
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.geometry.continuity import continuous_angles
from marey.geometry.vectors import unit_or_zero
from marey.io.atomic import replacing
from marey.motion.from_fit import joint_centre_sds
from marey.motion.motion import FILLED, LOST, MEASURED, NO_PERSON, BodyMotion
from marey.view.pages.curves import NumberTable, PlotGroup, group_data
from marey.view.pages.html import MOST_FRAMES, PageHead, Still, packed, rendered, span_of
from marey.view.pages.problems import Problem, readable
from marey.view.pictures.palette import OTHER, SEGMENTS, bone_pairs, side_colour

_GROUPS = ("pelvis", "thorax", "trunk", "head", "hip", "knee", "ankle", "toe", "clavicle", "shoulder", "elbow")
"""Order of the groups of angle plots, from the trunk outward."""
_HEADING, _SAME_TURN = "pelvis_rotation", "thorax_rotation"
"""Angles of a person's heading in the room: the second one is shown in the same turn as the first."""
_ANGLE_HEAD = ("angle", "minimum [°]", "maximum [°]", "typical 95 % interval [°]", "determined [% of frames]")
"""Head of the table of angles."""
_GROUPS_AFTER = {"forearm": "elbow"}
"""Segments whose angles are shown with those of another joint."""


@dataclass(frozen=True, kw_only=True)
class Size:
    """One body dimension, such as the stature or the length of a segment, with its standard deviation."""

    name: str
    value_m: float
    sd_m: float


@dataclass(frozen=True, eq=False, kw_only=True)
class ReportContent:
    """Content of the capture report."""

    title: str
    motion: BodyMotion
    body: Body
    """The body; the replay poses it by the segments of the motion."""
    rig: Rig
    requested: Mask | None = None
    """(F,) true for the selected frames; all by default."""
    sizes: Sequence[Size] = ()
    """Body dimensions, the stature first."""
    tables: Sequence[NumberTable] = ()
    """Further tables, after the body dimensions."""
    cycle: PlotGroup | None = None
    """Angles over the gait cycle; None if the motion is no walk."""
    problems: Sequence[Problem] = ()
    notes: Sequence[str] = ()
    stills: Sequence[Still] = ()
    timings: Mapping[str, float] = field(default_factory=dict)
    """Seconds by stage."""
    settings: Mapping[str, object] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    """Content of the files beside the report, by file name."""
    rounds: Sequence[tuple[float, float]] = ()
    """Energy [nat per frame] and overlap of each round in which silhouettes and pose were estimated in turn."""
    tracks: Mapping[str, tuple[int, float]] = field(default_factory=dict)
    """Number of tracked patches of the surface and their mean length in frames, by readable name of the segment."""
    hidden: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """By camera, the mean share of the person that something hides, and the share of the image in which a thing of the
    room stands in front of the person, from 0 to 1; empty if nothing is hidden."""
    head: PageHead = field(default_factory=PageHead)


def write_report(path: Path, content: ReportContent) -> None:
    """Write the report.

    Args:
        path: The HTML file.
        content: The content of the report.
    """
    with replacing(path) as beside:
        beside.write_text(report_html(content), encoding="utf-8")


def report_html(content: ReportContent) -> str:
    """Return the report as one HTML document that loads nothing from elsewhere."""
    problems = [each for each in content.problems if not content.head.has_reason(each.what)]
    return rendered(
        "report.html",
        content,
        data=_data(content),
        findings=[each.severity for each in problems],
        problems=problems,
        tiles=_tiles(content),
        sizes=_sizes(content.sizes),
        sides=any(len(values) > 1 for _, values in _sizes(content.sizes)),
        joints=[
            (i, readable(name))
            for i, name in enumerate(content.motion.joint_names)
            if np.isfinite(content.motion.joint_centres[:, i]).any()
        ],
        rounds=_rounds(content.rounds),
        angle_table=angle_table(content.motion),
        overlays=[name for names in content.files for name in names.split(", ") if name.startswith("overlay_")],
    )


def _rounds(rounds: Sequence[tuple[float, float]]) -> list[tuple[str, str, float]]:
    """Return energy, overlap, and the length of a bar [%] of each round: how much of the fall of the energy is left."""
    energies = [energy for energy, _ in rounds]
    fall = max(energies, default=0.0) - min(energies, default=0.0)
    return [
        (f"{energy:.0f}", f"{overlap:.3f}", 100 * (energy - min(energies)) / fall if fall > 0 else 0.0)
        for energy, overlap in rounds
    ]


def _tiles(content: ReportContent) -> list[tuple[str, str, str]]:
    """Return the key figures: label, value, and the line below."""
    motion = content.motion
    requested = motion.state if content.requested is None else motion.state[content.requested]
    counts = {state: int((requested == state).sum()) for state in (NO_PERSON, MEASURED, FILLED, LOST)}
    others = [f"{counts[FILLED]} filled, {counts[LOST]} lost"]
    others += [f"{counts[NO_PERSON]} without a person"] if counts[NO_PERSON] else []
    others += [f"{len(motion) - len(requested)} not selected"] if len(requested) < len(motion) else []
    known = motion.agreement[np.isfinite(motion.agreement)]
    tiles = [
        ("frames measured", f"{counts[MEASURED]} of {len(requested) - counts[NO_PERSON]}", ", ".join(others)),
        ("duration", f"{_duration(len(requested), motion.rate):.2f} s", f"{motion.rate:g} Hz, {len(requested)} frames"),
        ("cameras", f"{len(content.rig)}", ", ".join(content.rig.names)),
        ("agreement", f"{np.mean(known):.3f}" if known.size else "none", "surface and silhouettes, mean overlap"),
    ]
    for size in [size for size in content.sizes if size.name == "stature"]:
        tiles.append((size.name, f"{size.value_m:.3f} m", f"± {1.96 * size.sd_m * 1e3:.0f} mm (95 %)"))
    own, whole = (1960 * sd for sd in joint_centre_sds(motion, content.body))
    if np.isfinite(whole):
        below = "along X, Y or Z for a typical joint (95 %)"
        below += f"; constant offset included, ± {own:.0f} mm without it" if whole > own else ""
        tiles.append(("joint centres", f"± {whole:.0f} mm", below))
    return tiles


def _duration(frames: int, rate: float) -> float:
    """Return the time from the first to the last of some frames [s]."""
    return max(frames - 1, 0) / rate


def _sizes(sizes: Sequence[Size]) -> list[tuple[str, tuple[Size | None, ...]]]:
    """Combine left and right of a dimension: name, and the left and the right value, or the only one.

    Sides that the model holds equal are one value: they are not two measurements.
    """
    rows: dict[str, list[Size | None]] = {}
    for size in sizes:
        side, _, rest = size.name.partition(" ")
        name = rest if side in ("left", "right") else size.name
        rows.setdefault(name, [None, None])[int(side == "right")] = size
    return [(name, (left,) if _alike(left, right) else (left, right)) for name, (left, right) in rows.items()]


def _alike(left: Size | None, right: Size | None) -> bool:
    """Return whether there is one value only: no other side, or an equal one."""
    return right is None or (left is not None and bool(np.isclose(left.value_m, right.value_m, rtol=1e-9)))


def _data(content: ReportContent) -> dict[str, object]:
    span = slice(None) if content.requested is None else span_of(content.requested)
    motion = content.motion.frames(span)
    stride = -(-len(motion) // MOST_FRAMES)
    shown = motion.frames(slice(None, None, stride))
    return {
        "frames": len(shown),
        "first": span.start or 0,
        "stride": stride,
        "rate": motion.rate,
        "time": packed(shown.time, "f4"),
        "state": packed(shown.state, "u1"),
        "angles": _angles(shown),
        "cycle": None if content.cycle is None else group_data(content.cycle),
        "joints": _joints(shown),
        "cameras": {"names": list(shown.camera_names), "agreement": packed(shown.agreement, "f4")},
        "replay": _replay(shown, content.body, content.rig),
    }


def _angles(motion: BodyMotion) -> dict[str, object]:
    """Return the angles and their plots; left and right of a joint share a plot."""
    known = motion.angles_determined
    return {
        "count": len(motion.angle_names),
        "values": packed(shown_angles(motion), "f4"),
        "sd": packed(motion.angles_deg_sd, "f4"),
        "determined": None if known is None else packed(known, "u1"),
        "plots": angle_plots(motion.angle_names, np.asarray(np.isfinite(motion.angles_deg).any(0))),
    }


def shown_angles(motion: BodyMotion) -> Floats:
    """Return the angles (F, A) as a page shows them [deg]: continuous, and pelvis and thorax in the same turn."""
    angles = continuous_angles(motion.angles_deg, period=360.0, centred=True)
    if {_HEADING, _SAME_TURN} <= set(motion.angle_names):
        first, second = (motion.angle_names.index(name) for name in (_HEADING, _SAME_TURN))
        apart = angles[:, second] - angles[:, first]
        if np.isfinite(apart).any():
            angles[:, second] -= 360.0 * np.round(np.nanmedian(apart) / 360.0)
    return angles


def angle_table(motion: BodyMotion) -> NumberTable | None:
    """Return the table of the angles over the measured frames: range, interval, and share of frames that determine it.

    Args:
        motion: The motion.

    Returns:
        The table; None if no angle was measured.
    """
    measured = motion.state == MEASURED
    angles, sds, known = shown_angles(motion)[measured], motion.angles_deg_sd[measured], motion.angles_determined
    rows = []
    for i, name in enumerate(motion.angle_names):
        own = angles[:, i][np.isfinite(angles[:, i])]
        if own.size:
            half, share = 1.96 * np.median(sds[:, i]), None if known is None else known[measured, i].mean()
            row = [readable(name), _signed(own.min()), _signed(own.max()), f"± {half:.1f}"]
            rows.append([*row, "unknown" if share is None else f"{100 * share:.0f}"])
    return NumberTable(title="Angles", head=_ANGLE_HEAD, rows=rows) if rows else None


def _signed(value: float) -> str:
    """Format an angle [deg] with one digit and a true minus sign, without a minus before a zero."""
    return f"{value + 0.0:z.1f}".replace("-", "−")


def angle_plots(names: Sequence[str], known: Mask) -> list[dict[str, Any]]:
    """Return the plots of angles, those of the trunk first; left and right of a joint share a plot.

    Args:
        names: A names of angles.
        known: (A,) true for angles that have values; the others are left out.

    Returns:
        By plot its group, its title, and its curves: index, label and colour of each.
    """
    plots: dict[str, dict[str, Any]] = {}
    for i, name in enumerate(names):
        if not known[i]:
            continue
        side, base = _split_side(name)
        plots.setdefault(base, {"group": _group(base), "title": readable(base), "curves": []})
        plots[base]["curves"].append({"index": i, "label": side or readable(base), "colour": side_colour(name)})
    order = [*_GROUPS, "wrist"]
    return sorted(plots.values(), key=lambda plot: order.index(plot["group"]) if plot["group"] in order else len(order))


def _split_side(name: str) -> tuple[str, str]:
    side, _, rest = name.partition("_")
    return (side, rest) if side in ("left", "right") else ("", name)


def _group(base: str) -> str:
    first = base.partition("_")[0]
    return _GROUPS_AFTER.get(first, first)


def _joints(motion: BodyMotion) -> dict[str, object]:
    return {
        "names": [readable(name) for name in motion.joint_names],
        "colours": [side_colour(name) for name in motion.joint_names],
        "bones": bone_pairs(motion.joint_names).tolist(),
        "centres": packed(motion.joint_centres, "f4"),
        "sd": packed(motion.joint_centres_sd, "f4"),
    }


def _replay(motion: BodyMotion, body: Body, rig: Rig) -> dict[str, object]:
    """Return the body at rest and the motion of the segments; the page blends the skin."""
    order = [motion.segment_names.index(name) for name in body.skeleton.segment_names]
    return resting_body(body) | {
        "rotation": packed(motion.segment_rotation[:, order], "f4"),
        "origin": packed(motion.segment_origin[:, order], "f4"),
        "cameras": camera_views(rig),
    }


def resting_body(body: Body) -> dict[str, object]:
    """Return the body at rest with the weights of its skin, for the scripts of a page."""
    colours = [SEGMENTS.get(name, OTHER) for name in body.skeleton.segment_names]
    owner = body.vertex_segments[np.arange(len(body.vertices)), np.argmax(body.vertex_weights, 1)]
    return {
        "segments": len(colours),
        "rest": packed(body.vertices, "f4"),
        "normals": packed(np.round(127 * _normals(body)), "i1"),
        "faces": packed(body.faces, "u4"),
        "vertexSegments": packed(body.vertex_segments, "u1"),
        "vertexWeights": packed(np.round(255 * body.vertex_weights), "u1"),
        "colours": colours,
        "owner": packed(owner, "u1"),
        "restJoints": packed(body.joint_centres, "f4"),
    }


def camera_views(rig: Rig) -> list[dict[str, object]]:
    """Return the cameras with their lenses, for the scripts of a page."""
    return [
        {
            "name": camera.name,
            "size": list(camera.size),
            "matrix": camera.matrix.tolist(),
            "rotation": camera.camera_from_world.rotation.tolist(),
            "translation": camera.camera_from_world.translation.tolist(),
            "lens": _lens(camera),
        }
        for camera in rig
    ]


def _lens(camera: Camera) -> dict[str, object] | None:
    """Return model, coefficients and limit of a lens as in `marey.cameras.lens`; None without a distortion."""
    packed_camera = camera.packed
    model, coefficients = int(packed_camera[lens.MODEL]), packed_camera[lens.LENS : lens.LIMIT]
    if model == 0 and not coefficients.any():
        return None
    limit = float(packed_camera[lens.LIMIT])
    return {"model": model, "coefficients": coefficients.tolist(), "limit": limit if np.isfinite(limit) else None}


def _normals(body: Body) -> Floats:
    """Return the unit normals (V, 3) of the skin at rest."""
    corners = body.vertices[body.faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(body.vertices)
    for i in range(3):
        np.add.at(normals, body.faces[:, i], area)
    return unit_or_zero(normals)
