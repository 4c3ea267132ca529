"""The report: one HTML file with curves, replay, pictures and doubts, that opens anywhere without a network."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from marey.arrays import Floats, Mask
from marey.body.articulation.surface import Body
from marey.cameras.rig import Rig
from marey.io.atomic import replacing
from marey.motion.motion import FILLED, LOST, MEASURED, NOBODY, BodyMotion
from marey.view.pages.html import MOST_FRAMES, Still, packed, rendered
from marey.view.pages.problems import Problem, readable
from marey.view.pictures.palette import OTHER, SEGMENTS, bone_pairs, side_colour

_GROUPS = ("pelvis", "thorax", "trunk", "head", "hip", "knee", "ankle", "toe", "clavicle", "shoulder", "elbow")
_GROUPS_AFTER = {"forearm": "elbow"}


@dataclass(frozen=True, kw_only=True)
class Size:
    """One size of the person, such as the stature or a segment's length."""

    name: str
    value_m: float
    sd_m: float


@dataclass(frozen=True, eq=False, kw_only=True)
class ReportContent:
    """All that the report tells."""

    title: str
    motion: BodyMotion
    body: Body
    """Found or given; posed by the motion's segments in the replay."""
    rig: Rig
    asked: Mask | None = None
    """(F,) the frames that were to be captured; all when missing."""
    sizes: Sequence[Size] = ()
    """The stature first, then what else is known."""
    problems: Sequence[Problem] = ()
    stills: Sequence[Still] = ()
    timings: Mapping[str, float] = field(default_factory=dict)
    """Seconds by stage."""
    settings: Mapping[str, object] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    """What the files beside the report hold."""


def write_report(path: Path, content: ReportContent) -> None:
    """Write the report.

    Args:
        path: The HTML file.
        content: What it tells.
    """
    with replacing(path) as beside:
        beside.write_text(report_html(content), encoding="utf-8")


def report_html(content: ReportContent) -> str:
    """Give the report's text: one HTML document that loads nothing from elsewhere."""
    return rendered(
        "report.html",
        content,
        data=_data(content),
        tiles=_tiles(content),
        sizes=_sizes(content.sizes),
        joints=[readable(name) for name in content.motion.joint_names],
    )


def _tiles(content: ReportContent) -> list[tuple[str, str, str]]:
    """Give the key figures: label, value, and what stands below it."""
    motion = content.motion
    asked = motion.state if content.asked is None else motion.state[content.asked]
    counts = {state: int((asked == state).sum()) for state in (NOBODY, MEASURED, FILLED, LOST)}
    others = [f"{counts[FILLED]} filled, {counts[LOST]} lost"]
    others += [f"{counts[NOBODY]} without a person"] if counts[NOBODY] else []
    others += [f"{len(motion) - len(asked)} not asked for"] if len(asked) < len(motion) else []
    known = motion.agreement[np.isfinite(motion.agreement)]
    tiles = [
        ("frames measured", f"{counts[MEASURED]} of {len(asked) - counts[NOBODY]}", ", ".join(others)),
        ("duration", f"{len(asked) / motion.rate:.2f} s", f"{motion.rate:g} Hz, {len(asked)} frames"),
        ("cameras", f"{len(content.rig)}", ", ".join(content.rig.names)),
        ("agreement", f"{np.mean(known):.3f}" if known.size else "none", "surface and silhouettes, mean overlap"),
    ]
    for size in content.sizes[:1]:
        tiles.append((size.name, f"{size.value_m:.3f} m", f"± {1.96 * size.sd_m * 1e3:.0f} mm (95 %)"))
    middle = _median_sd_mm(motion)
    if middle is not None:
        tiles.append(("joint centres", f"± {1.96 * middle:.0f} mm", "median 95 % interval of a coordinate"))
    return tiles


def _median_sd_mm(motion: BodyMotion) -> float | None:
    values = motion.joint_centres_sd[np.isfinite(motion.joint_centres_sd)]
    return float(np.median(values)) * 1e3 if values.size else None


def _sizes(sizes: Sequence[Size]) -> list[tuple[str, tuple[Size | None, Size | None]]]:
    """Put left and right of a size into one row: its name, the left or only one, and the right one."""
    rows: dict[str, list[Size | None]] = {}
    for size in sizes:
        side, _, rest = size.name.partition(" ")
        name = rest if side in ("left", "right") else size.name
        rows.setdefault(name, [None, None])[int(side == "right")] = size
    return [(name, (left, right)) for name, (left, right) in rows.items()]


def _data(content: ReportContent) -> dict[str, object]:
    motion = content.motion
    stride = -(-len(motion) // MOST_FRAMES)
    shown = motion.frames(slice(None, None, stride))
    return {
        "frames": len(shown),
        "stride": stride,
        "rate": motion.rate,
        "time": packed(shown.time, "f4"),
        "state": packed(shown.state, "u1"),
        "angles": _angles(shown),
        "joints": _joints(shown),
        "cameras": {"names": list(shown.camera_names), "agreement": packed(shown.agreement, "f4")},
        "replay": _replay(shown, content.body, content.rig),
    }


def _angles(motion: BodyMotion) -> dict[str, object]:
    """Give the angles, and the plots in which they stand: left and right of a joint share one."""
    plots: dict[str, dict] = {}
    for i, name in enumerate(motion.angle_names):
        side, base = _split_side(name)
        plots.setdefault(base, {"group": _group(base), "title": readable(base), "curves": []})
        plots[base]["curves"].append({"index": i, "label": side or readable(base), "colour": side_colour(name)})
    order = [*_GROUPS, "wrist"]
    ranked = sorted(
        plots.values(), key=lambda plot: order.index(plot["group"]) if plot["group"] in order else len(order)
    )
    return {
        "count": len(motion.angle_names),
        "values": packed(motion.angles_deg, "f4"),
        "sd": packed(motion.angles_deg_sd, "f4"),
        "plots": ranked,
    }


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
    """Give the body at rest and the segments' motion: the page itself blends the skin."""
    colours = [SEGMENTS.get(name, OTHER) for name in body.skeleton.segment_names]
    owner = body.vertex_segments[np.arange(len(body.vertices)), np.argmax(body.vertex_weights, 1)]
    order = [motion.segment_names.index(name) for name in body.skeleton.segment_names]
    return {
        "segments": len(order),
        "rest": packed(body.vertices, "f4"),
        "normals": packed(np.round(127 * _normals(body)), "i1"),
        "faces": packed(body.faces, "u4"),
        "vertexSegments": packed(body.vertex_segments, "u1"),
        "vertexWeights": packed(np.round(255 * body.vertex_weights), "u1"),
        "colours": colours,
        "owner": packed(owner, "u1"),
        "restJoints": packed(body.joint_centres, "f4"),
        "rotation": packed(motion.segment_rotation[:, order], "f4"),
        "origin": packed(motion.segment_origin[:, order], "f4"),
        "cameras": [
            {
                "name": camera.name,
                "size": list(camera.size),
                "matrix": camera.matrix.tolist(),
                "rotation": camera.camera_from_world.rotation.tolist(),
                "translation": camera.camera_from_world.translation.tolist(),
            }
            for camera in rig
        ],
    }


def _normals(body: Body) -> Floats:
    """Give the skin's unit normals (V, 3) at rest."""
    corners = body.vertices[body.faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(body.vertices)
    for i in range(3):
        np.add.at(normals, body.faces[:, i], area)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
