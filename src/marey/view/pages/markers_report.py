"""The report of bones from skin markers: curves of all methods, motion of the markers, and tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marey.arrays import Floats, Mask
from marey.io.atomic import replacing
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.marker_motion import MarkerMotion
from marey.markers.kinematics.joint_angles import JointKinematics
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
from marey.view.pages.html import NO_HEAD, PageHead, files_beside, rendered, span_of
from marey.view.pages.marker_scene import MarkerPaths, frames_apart, marker_legend, marker_scene
from marey.view.pages.problems import readable

FILES = {
    "bones.npz": "pose of each bone: rotation, origin in mm, and standard deviations",
    "bones_<method>.npz": "the same for the other methods",
    "angles.mot, angles.csv": "joint angles and translations with standard deviations",
    "assumed.csv": "measurements of the person that are assumed, and what they contribute to the angles",
    "gait.csv, gait_cycles.csv": "spatio-temporal parameters: means with intervals, and each cycle",
    "cycles.csv, events.csv, events.mot": "angles over the gait cycle; foot strikes and foot offs",
    "repetitions.csv": "squats, sitting down and standing up, and jumps",
    "given_angles.csv, given_agreement.csv": "angles of another program in the file, and how ours agree with them",
    "marker_motion.csv": "position of each marker in the frame of its bone",
    "landmark_motion.csv": "landmarks of the static trial in every frame, carried by their bones",
    "filled.csv": "filled gaps with their method and standard deviation",
    "frames.json": "frames of the force plates in the laboratory",
    "motion.c3d": "the original trial, and the bones as 4x4 matrices (C3D ROTATION)",
    "orientations.sto": "orientations of the bones, for OpenSense",
    "run.json": "version, settings, inputs, timings",
}
"""Files beside the report and their content."""
_MEANING = {
    "Bone": "The frame of a segment, defined by the anatomical calibration in one or several postures and followed by "
    "means of the markers. An error of the calibration is a constant error in every frame.",
    "95 % interval": "1.96 standard deviations as stated by the method. The intervals of joints combine both bones as "
    "if their errors were independent. A motion common to all markers of a segment, such as sliding of the whole "
    "skin, is included only if the method has a model of the skin with its typical size.",
    "Joint angles": "Defined after Grood and Suntay: flexion about the parent's Z axis, rotation about the child's Y "
    "axis, adduction about the axis perpendicular to both; positive are flexion, adduction, internal rotation, "
    "dorsiflexion, inversion. They are anatomical only if the frames of the bones are: X forward, Y up, Z to the "
    "right. If the motion of a knee contradicts this, the verdict says that it does not bend about the Z axes of its "
    "bones, or that its angles are impossible.",
    "Typical 95 % interval": "Median over the frames of 1.96 standard deviations, the number after ±. Where it reaches "
    "the range (largest minus smallest value) of an angle or translation, the markers do not measure how that changes.",
    "Translations": "Displacement of the child at the centre of the joint from its place in the reference posture: "
    "lateral along the parent's Z, anterior along the floating axis, distraction along the child's Y. The centre is "
    "the place that moves least in both bones.",
    "Total rotation": "Rotation angle of the child relative to the parent since the reference frame, about any axis. "
    "Without an anatomical calibration this is the quantity that markers determine.",
    "Motion of the markers": "Root mean square distance of the markers of a segment from their mean positions on the "
    "estimated bone. A method that models sliding skin shows larger values than one that follows all markers: it is "
    "not an error. The notes of the method skin state another quantity: how far a marker is from its place in the "
    "reference posture, not from its mean position.",
    "Choice of a method": "The default method, skin, is recommended. The standard deviations of two methods can be "
    "compared only if both include the same errors: those of rigid clusters contain the noise and the change of the "
    "cluster's shape, but not skin that slides as a whole.",
    "Differences of methods": "Root mean square difference from the angle of the first method over the frames in which "
    "both have a result. They show how much depends on the method, not which method is correct.",
}
"""Explanations of the terms on the page."""
_OF_A_MODEL = {
    "Bone": "A body of the model. All bodies are fitted to all markers together, within the joints of the model. The "
    "scaling of the model and the positions of its markers determine what the angles mean.",
    "Joint angles": "The coordinates of the model with its names and signs. A coordinate that the markers do not "
    "determine keeps the value of a task, a limit or the default of the model; the notes list it.",
    "Translations": "The coordinates of the model that are lengths.",
    "95 % interval": "1.96 standard deviations, from the residuals of each marker over the trial. It does not include "
    "errors that the residuals do not show, such as skin that moves as a whole over its segment.",
}
"""Explanations that replace those of `_MEANING` for the coordinates of a model."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MethodView:
    """Results of one method for the page."""

    name: str
    summary: str
    motion: BoneMotion
    joints: JointKinematics
    markers: MarkerMotion
    seconds: float


def write_markers_report(
    path: Path, *, title: str, time: Floats, requested: Mask, methods: Sequence[MethodView], anatomical: bool,
    notes: Sequence[str], filled: int, timings: Mapping[str, float], settings: Mapping[str, object],
    paths: MarkerPaths, more: Sequence[PlotGroup] = (), more_tables: Sequence[NumberTable] = (),
    files: Mapping[str, str] = FILES, of_model: bool = False,
    head: PageHead = NO_HEAD,
) -> None:  # fmt: skip
    """Write report.html of a run on markers.

    Args:
        path: The file.
        title: Name of the trial.
        time: (F,) [s].
        requested: (F,) true for the estimated frames.
        methods: Results by method; those of the first are the results of the run.
        anatomical: Whether joint angles are anatomical; otherwise they are rotations since the reference.
        notes: Notes for the reader.
        filled: Number of filled points.
        timings: Seconds by stage.
        settings: Settings as in run.json.
        paths: The markers for the 3-D view.
        more: Further plots.
        more_tables: Further tables, before those of the methods.
        files: Files beside the report.
        of_model: Whether the angles are coordinates of a model.
        head: What the head of the page states about the run.
    """
    first = methods[0]
    keys = [(m.name, _colour(i)) for i, m in enumerate(methods)] if len(methods) > 1 else []
    tables = [*more_tables, *([_methods_table(methods, requested)] if len(methods) > 1 else [])]
    tables += [_angles_table(first), _segments_table(first, requested)]
    tables += [_differences(methods)] if len(methods) > 1 else []
    groups = [
        _joint_group(methods, keys, anatomical=anatomical),
        _translation_group(methods, keys),
        *more,
        _marker_group(methods, keys),
        _interval_group(first),
    ]
    beside = files_beside(files, [each.name for each in path.parent.iterdir()])
    content = CurvesContent(
        kind="Bones from skin markers", title=title, time=time, shown=span_of(requested), head=head,
        tiles=_tiles(first, time, requested, filled, methods),
        notes=notes, tables=[t for t in tables if t.rows], groups=[g for g in groups if g.plots], timings=timings,
        settings=settings, files=beside, meaning=_MEANING | (_OF_A_MODEL if of_model else {}),
    )  # fmt: skip
    with replacing(path) as temporary:
        temporary.write_text(_with_scene(content, paths, first), encoding="utf-8")


def _with_scene(content: CurvesContent, paths: MarkerPaths, first: MethodView) -> str:
    """Return the page with its 3-D view."""
    shown = content.shown or slice(None)
    start, end, _ = shown.indices(len(content.time))
    stride = stride_of(end - start)
    frames = -(-(end - start) // stride)
    every = frames_apart(paths, len(first.motion.segments), frames)
    time = content.time
    data = curves_data(content, stride) | {
        "rate": (len(time) - 1) / float(time[-1] - time[0]) if len(time) > 1 else 1.0, "stride": stride, "first": start,
        "markers": marker_scene(
            paths, first.motion, first.markers, frames=slice(start, end, stride * every), every=every
        ),
    }  # fmt: skip
    return rendered("markers.html", content, data=data, replay_legend=marker_legend(every))


def _colour(index: int) -> str:
    return COLOURS[index % len(COLOURS)]


def _tiles(
    first: MethodView, time: Floats, requested: Mask, filled: int, methods: Sequence[MethodView]
) -> list[tuple[str, str, str]]:
    answered = first.motion.answered[requested]
    whole = int(answered.all(1).sum())
    below = f"{int(answered.any(1).sum())} with at least one bone"
    rate = (len(time) - 1) / (time[-1] - time[0]) if len(time) > 1 else np.nan
    sd = np.degrees(np.nanmedian(first.motion.rotation_sd)) if np.isfinite(first.motion.rotation_sd).any() else np.nan
    tiles = [
        ("frames with all bones", f"{whole} of {int(requested.sum())}", below),
        ("duration", f"{time[-1] - time[0]:.2f} s", f"{rate:g} Hz, {len(time)} frames"),
        ("segments", f"{len(first.motion.segments)}", ", ".join(map(readable, first.motion.segments[:6]))),
        ("method", first.name, _other_methods(methods) if len(methods) > 1 else first.summary),
    ]
    if np.isfinite(sd):
        tiles.append(("orientation of bones", f"± {1.96 * sd:.1f}°", "median 95 % interval about one axis"))
    rms = first.markers.rms[np.isfinite(first.markers.rms)]
    if len(rms):
        last = int(np.nanargmax(first.markers.rms))
        text = f"largest: {first.markers.labels[last]}, {1e3 * first.markers.rms[last]:.1f} mm"
        mean = f"{1e3 * np.sqrt(np.mean(rms**2)):.1f} mm"
        tiles.append(("motion of markers", mean, f"relative to their bones, RMS; {text}"))
    if filled:
        tiles.append(("points filled", f"{filled}", "listed in filled.csv"))
    return tiles


def _other_methods(methods: Sequence[MethodView]) -> str:
    return f"compared with: {', '.join(each.name for each in methods[1:])}"


def _methods_table(methods: Sequence[MethodView], requested: Mask) -> NumberTable:
    rows = [
        [
            m.name, f"{100 * m.motion.answered[requested].mean():.1f} %", _root_mean_square(1e3 * m.markers.rms),
            _typical(np.degrees(m.motion.rotation_sd)), _typical(1e3 * m.motion.origin_sd), f"{m.seconds:.2f}",
            m.summary,
        ]
        for m in methods
    ]  # fmt: skip
    return NumberTable(
        title="Methods",
        head=(
            "method", "frames with result", "motion of markers mm", "sd of rotation °", "sd of origin mm", "time s",
            "description",
        ),
        rows=rows, marked=0, text_columns=(0, 6),
        legend="The files contain the results of the first method. Standard deviations are medians, about or along "
        "one axis. Those of methods that ignore skin sliding as a whole, such as rigid, are smaller for this reason, "
        "not because the result is more accurate. The default method, skin, is recommended.",
    )  # fmt: skip


def _root_mean_square(values: Floats) -> str:
    known = values[np.isfinite(values)]
    return f"{np.sqrt(np.mean(known**2)):.2f}" if known.size else ""


def _typical(values: Floats) -> str:
    known = values[np.isfinite(values)]
    return f"{np.median(known):.2f}" if known.size else ""


def _angles_table(first: MethodView) -> NumberTable:
    """Return the range and the typical interval of each joint angle and translation."""
    joints, rows = first.joints, []
    kinds = (
        (joints.angle_names, np.degrees(joints.angles), np.degrees(joints.angles_sd), "°"),
        (joints.translation_names, 1e3 * joints.translations, 1e3 * joints.translations_sd, "mm"),
    )
    for names, values, spreads, unit in kinds:
        for k, name in enumerate(names):
            known = values[np.isfinite(values[:, k]), k]
            if len(known):
                sd = spreads[np.isfinite(spreads[:, k]), k]
                interval = (f"± {1.96 * np.median(sd):.1f}", f"± {1.96 * sd.max():.1f}") if len(sd) else ("", "")
                ends = [f"{value:.1f}".replace("-", "−") for value in (known.min(), known.max())]
                rows.append([readable(name), *ends, *interval, unit])
    return NumberTable(
        title="Joint angles and translations",
        head=("quantity", "smallest", "largest", "typical 95 % interval", "widest", "unit"), rows=rows,
        legend=f"Over all frames with a result, method {first.name}. Typical: median over the frames.",
        text_columns=(0, 5),
    )  # fmt: skip


def _segments_table(first: MethodView, requested: Mask) -> NumberTable:
    rows = []
    for s, name in enumerate(first.motion.segments):
        own = np.array([segment == name for segment in first.markers.segments], bool)
        rms, answered = first.markers.rms[own], first.motion.answered[requested, s]
        worst = ""
        if np.isfinite(rms).any():
            k = int(np.nanargmax(rms))
            labels = [label for label, mine in zip(first.markers.labels, own, strict=True) if mine]
            worst = f"{labels[k]}, {1e3 * rms[k]:.1f} mm"
        rows.append(
            [
                readable(name), f"{int(own.sum())}", f"{100 * answered.mean():.1f} %",
                _root_mean_square(1e3 * rms), worst,
                _typical(np.degrees(first.motion.rotation_sd[:, s])), _typical(1e3 * first.motion.origin_sd[:, s]),
            ]
        )  # fmt: skip
    return NumberTable(
        title="Segments",
        head=("segment", "markers", "frames with result", "motion of markers mm", "largest", "sd of rotation °", "sd "
        "of origin mm"),
        rows=rows, legend="Motion of the markers relative to the bone: root mean square distance from their mean "
        "positions.",
        text_columns=(0, 4),
    )  # fmt: skip


def _differences(methods: Sequence[MethodView]) -> NumberTable:
    first, rows = methods[0], []
    for m in methods[1:]:
        between = np.degrees(m.joints.angles - first.joints.angles)
        rows.append([m.name, *(_root_mean_square(column) for column in between.T)])
    return NumberTable(
        title="Differences of methods", head=("method", *(f"{readable(n)} °" for n in first.joints.angle_names)),
        rows=rows if first.joints.angle_names else [],
        legend=f"Root mean square difference to {first.name}.",
    )  # fmt: skip


def _joint_group(methods: Sequence[MethodView], keys: Sequence[tuple[str, str]], *, anatomical: bool) -> PlotGroup:
    names = methods[0].joints.angle_names
    plots = [
        CurvePlot(title=readable(name), curves=_curves(methods, "angles", k, 180 / np.pi))
        for k, name in enumerate(names)
    ]
    what = "Degrees over time [s]" if anatomical else "Rotation since the reference frame [degrees] over time [s]"
    return PlotGroup(title="Joint angles", plots=plots, keys=keys, legend=f"{what}; the band is the 95 % interval.")


def _translation_group(methods: Sequence[MethodView], keys: Sequence[tuple[str, str]]) -> PlotGroup:
    plots = [
        CurvePlot(title=readable(name), curves=_curves(methods, "translations", k, 1e3), unit=" mm")
        for k, name in enumerate(methods[0].joints.translation_names)
    ]
    return PlotGroup(title="Joint translations", plots=plots, keys=keys, legend="Millimetres over time [s].")


def _curves(methods: Sequence[MethodView], what: str, k: int, scale: float) -> list[Trace]:
    """Return one quantity of all methods; only the band of the first method is drawn."""
    curves = []
    for i, m in enumerate(methods):
        sd = getattr(m.joints, f"{what}_sd")[:, k] * scale if i == 0 else None
        values = getattr(m.joints, what)[:, k] * scale
        curves.append(Trace(label=m.name, colour=_colour(i), values=values, sd=sd))
    return curves[::-1]


def _marker_group(methods: Sequence[MethodView], keys: Sequence[tuple[str, str]]) -> PlotGroup:
    plots = [
        CurvePlot(
            title=readable(name), unit=" mm", least=1.0,
            curves=[
                Trace(label=m.name, colour=_colour(i), values=1e3 * m.markers.of(name)) for i, m in enumerate(methods)
            ][::-1],
        )
        for name in methods[0].motion.segments
        if name in methods[0].markers.segments
    ]  # fmt: skip
    legend = "Root mean square distance of the markers of a segment from their mean positions on the bone [mm]."
    return PlotGroup(title="Motion of the markers", plots=plots, keys=keys, legend=legend)


def _interval_group(first: MethodView) -> PlotGroup:
    """Return plots of the standard deviations of each bone over time."""
    plots = []
    for s, name in enumerate(first.motion.segments):
        turn, place = first.motion.rotation_sd[:, s], first.motion.origin_sd[:, s]
        if np.isfinite(turn).any():
            kinds = (("rotation", "°", np.degrees(turn.max(-1))), ("origin", " mm", 1e3 * place.max(-1)))
            for k, (what, unit, values) in enumerate(kinds):
                line = Trace(label="sd", colour=COLOURS[k], values=values)
                title = f"{readable(name)}, {what}"
                plots.append(CurvePlot(title=title, unit=unit, least=0.2, digits=2, curves=[line]))
    legend = "Standard deviation about or along the least certain axis."
    return PlotGroup(title="Standard deviation of each bone", plots=plots, legend=legend)
