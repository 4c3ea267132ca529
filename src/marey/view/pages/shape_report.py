"""The report of recovered shapes: replay, choices and their reasons, residuals, coefficients, pose."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from marey.arrays import Floats, Integers
from marey.geometry import rotations
from marey.io.atomic import replacing
from marey.nonrigid.recovered import IN_LABORATORY, INPUT_UNITS, UNKNOWN_UNIT, RankCurve, RecoveredShapes
from marey.view.pages.curves import (
    COLOURS,
    CurvePlot,
    CurvesContent,
    NumberTable,
    PlotGroup,
    PlotMark,
    Trace,
    curves_data,
    stride_of,
)
from marey.view.pages.html import PageHead, Still, files_beside, packed, rendered
from marey.wording import count_of, listed

FILES = {
    "shapes.npz": "shapes, poses, basis shapes, coefficients, standard deviations, residuals",
    "residuals.csv": "residuals point by point",
    "tracks.npz": "the points followed in the video",
    "tracks_<video>.npz": "the points followed in each video",
    "overlay_<video>.mp4": "the recovered points over the video and in a side view",
    "shapes.glb": "the moving points, for Blender and the web",
    "shapes.c3d": "the moving points and the pose of the object, for laboratory software",
    "shapes/": "one point cloud (PLY) per frame, in the frame of the object",
    "run.json": "version, settings, inputs, timings",
}
"""Files beside the report and their content."""
_MEANING = {
    "Shape and motion": "The tracks are modelled as the rigid motion of a shape that changes: a mean shape plus basis "
    "shapes with coefficients that vary over time. No other model of the object is used.",
    "Basis shapes": "Their number includes the mean shape; with one the object is rigid. Their number is as large "
    "as the data support; it is not a property of the object.",
    "Input unit": "The unit of the tracks or points as they were given, which the program does not know; pixels, for "
    "tracks in images.",
    "Residual": "Distance of a measured point from the model, in the unit of the input. It contains noise and "
    "deformation that the basis shapes do not describe; it does not contain errors in depth.",
    "95 % interval": "1.96 standard deviations of the recovered shape, from the noise and, where several camera paths "
    "explain the tracks equally well, from the difference between their solutions.",
    "Predicted": "A point that was not visible in a frame. Its position is estimated from the other points and from "
    "neighbouring frames.",
}
"""Explanations of the terms on the page."""
_MOST_NUMBERS = 600_000
"""Number of frames times points in the replay at most; longer recordings are subsampled. Chosen by hand."""
_MOST_COEFFICIENTS = 8
"""Number of coefficients that are plotted at most; chosen by hand."""
_MOST_ROWS = 24
"""Number of points in the table at most; residuals.csv contains all. Chosen by hand."""
_GAUGE_TITLE = "What the data do not determine"
"""Title of the table of conventions."""
_ENOUGH = 0.95
"""Share of the whole decrease of the error that a number of basis shapes reaches to be named. Chosen by hand."""
_LEGEND = (
    "Blue points were visible in the frame; orange points are predicted. The three short lines are the axes of the "
    "object, x (red), y (green), z (blue), at its origin. {lines} {axes}"
)
"""Legend of the replay."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ShapeReport:
    """Content of the report of recovered shapes."""

    title: str
    found: RecoveredShapes
    rate: float
    labels: Sequence[str]
    lines: Integers
    """(E, 2) pairs of points joined by lines."""
    own_lines: bool
    """Whether the lines come from the input."""
    upright: Floats
    """(3, 3) rotation of the axes of the camera or laboratory that makes Z the vertical."""
    views: Sequence[str] = ()
    """Names of the cameras; empty for points in space."""
    notes: Sequence[str] = ()
    track_curves: Sequence[Floats] = ()
    """For each video (n, 2): tested ranks of its tracks, and their held-out error [px]."""
    stills: Sequence[Still] = ()
    timings: Mapping[str, float] = field(default_factory=dict)
    settings: Mapping[str, object] = field(default_factory=dict)
    head: PageHead = field(default_factory=PageHead)
    files: Sequence[str] = ()
    """Names of the files beside the report; folders end with a slash."""


def write_shape_report(path: Path, report: ShapeReport) -> None:
    """Write report.html.

    Args:
        path: The file.
        report: The content of the report.
    """
    with replacing(path) as beside:
        beside.write_text(shape_html(report), encoding="utf-8")


def shape_html(report: ShapeReport) -> str:
    """Return the page as one HTML document that loads nothing from elsewhere."""
    found = report.found
    content = CurvesContent(
        kind="Shape of a deforming surface", title=report.title, time=np.arange(len(found)) / report.rate,
        tiles=_tiles(report), notes=report.notes, tables=[_gauge_table(found), _point_table(report)],
        groups=[group for group in _groups(report) if group.plots], stills=report.stills, timings=report.timings,
        settings=report.settings, files=files_beside(FILES, report.files), meaning=_MEANING, head=report.head,
    )  # fmt: skip
    frames, _, points = found.shape.shape
    stride = max(stride_of(frames), -(-frames * points // _MOST_NUMBERS))
    data = curves_data(content, stride) | {
        "rate": report.rate, "stride": stride, "frames": frames, "shapes": _replay(report, stride),
    }  # fmt: skip
    drawn = "The lines come from the input." if report.own_lines else "Lines join neighbouring points as a visual aid."
    up = f"The vertical is that of the {'laboratory' if found.kind in IN_LABORATORY else 'image'}."
    legend = _LEGEND.format(lines=drawn, axes=up)
    return rendered("shapes.html", content, data=data, replay_legend=legend)


def _replay(report: ShapeReport, stride: int) -> dict[str, object]:
    """Return the shapes, upright and scaled to the view, and the motion."""
    found, turn = report.found, report.upright
    size = max(float(np.nanpercentile(np.linalg.norm(found.shape, axis=1), 98)), 1e-12)
    shape = np.einsum("ij,fjp->fpi", turn, found.shape[::stride]) / size
    # The deviations belong to the object's axes; a quarter turn carries them along.
    sd = np.einsum("ij,fjp->fpi", np.abs(turn), found.shape_sd[::stride]) / size
    where = (found.origin - np.nanmean(found.origin, axis=0)) @ turn.T / size
    return {
        "count": found.shape.shape[2], "place": packed(shape, "f4"), "sd": packed(sd, "f4"),
        "predicted": packed(found.predicted[::stride], "u1"), "lines": report.lines.tolist(),
        "rotation": packed(turn @ found.rotation[::stride] @ turn.T, "f4"), "origin": packed(where[::stride], "f4"),
        "labels": list(report.labels),
    }  # fmt: skip


def _tiles(report: ShapeReport) -> list[tuple[str, str, str]]:
    found = report.found
    answered = found.answered
    points = int(np.isfinite(found.basis[0]).all(0).sum())
    size = 2 * float(np.sqrt(np.nanmean((found.basis[0] ** 2).sum(0))))
    sd = np.nanmedian(np.sqrt((found.shape_sd**2).sum(1)))
    seen = np.isfinite(found.residuals)
    rms = float(np.sqrt((np.where(seen, found.residuals, 0) ** 2).sum() / max(seen.sum(), 1)))
    chosen = "rigid" if found.basis_shapes == 1 else f"the mean and {found.basis_shapes - 1} that vary"
    worst = int(np.nanargmax(found.point_rms))
    left_open = [("not determined", found.undetermined[0], _left_open(found))] if found.undetermined else []
    tiles = [
        *left_open,
        ("frames with a result", f"{int(answered.sum())}", f"of {len(found)}, {report.rate:g} Hz"),
        ("points", f"{points}", f"of {found.shape.shape[2]}; {int(found.predicted.sum())} places predicted"),
        ("cameras", f"{len(report.views)}" if report.views else "none", ", ".join(report.views[:4]) or found.kind),
        ("basis shapes", f"{found.basis_shapes}", chosen),
        ("residual", found.residual_text(rms), f"root mean square; largest: point {report.labels[worst]}"),
        ("shape", f"± {found.length_text(1.96 * float(sd))}", f"median 95 % interval; size {found.length_text(size)}"),
    ]  # fmt: skip
    if np.isfinite(found.metres_per_unit) and found.unit != "m":
        tiles.append(("scale", f"{1e3 * found.metres_per_unit:.4g} mm", "per unit of the input"))
    return tiles


def _left_open(found: RecoveredShapes) -> str:
    """Return what is not determined beside the first of it, and where the page explains it."""
    more = found.undetermined[1:]
    return f"{'and ' + listed(more) + '; ' if more else ''}see “{_GAUGE_TITLE}”"


def _gauge_table(found: RecoveredShapes) -> NumberTable:
    parts = [line.partition(": ") for line in found.gauge]
    rows = [(what, text[:1].upper() + text[1:]) for what, _, text in parts]
    return NumberTable(
        title=_GAUGE_TITLE, head=("quantity", "choice"), rows=rows, text_columns=(0, 1),
        legend=f"Method: {found.kind}. A comparison with another result must take each of these into account.",
    )  # fmt: skip


def _point_table(report: ShapeReport) -> NumberTable:
    found = report.found
    seen = np.isfinite(found.residuals).any(0).sum(0)
    sd = np.sqrt((found.shape_sd**2).sum(1))
    order = np.argsort(np.where(np.isfinite(found.point_rms), -found.point_rms, np.inf), kind="stable")
    rows = []
    for p in order[:_MOST_ROWS]:
        known = sd[:, p][np.isfinite(sd[:, p])]
        cells = ["", ""]
        if len(known):
            texts = found.residual_text(found.point_rms[p]), found.length_text(float(np.median(known)))
            cells = [text.removesuffix(INPUT_UNITS) for text in texts]
        rows.append((report.labels[p], f"{seen[p]}", f"{found.predicted[:, p].sum()}", *cells))
    legend = "Sorted by residual, the largest first; residuals.csv contains all points."
    if UNKNOWN_UNIT in (found.unit, found.residual_unit):
        legend += f" Lengths without a unit are in{INPUT_UNITS}."
    head = ("point", "frames seen", "frames predicted", "residual RMS", "sd, median")
    return NumberTable(title="Residuals by point", rows=rows, head=head, legend=legend)


def _groups(report: ShapeReport) -> list[PlotGroup]:
    found = report.found
    return [
        PlotGroup(
            title="Number of basis shapes", plots=[*_rank_plots(found), *_track_rank_plots(report)],
            legend=_rank_legend(report),
        ),
        PlotGroup(title="By frame", plots=_frame_plots(report), legend=_frame_legend(found)),
        PlotGroup(
            title="Coefficients", plots=_coefficient_plots(found),
            legend=f"Coefficient of each basis shape [{found.unit}], the largest first, over time [s].",
        ),
        PlotGroup(
            title="Rotation of the object", plots=_turn_plots(found),
            legend="Rotation vector since the first frame with a result, in degrees about the axes of the camera or "
            "laboratory, with 95 % intervals.",
        ),
    ]  # fmt: skip


def _frame_legend(found: RecoveredShapes) -> str:
    """Return the legend of the curves of `_frame_plots`, with their units."""
    return (
        f"Number of points that were seen, residuals [{found.residual_unit}], and standard deviations of the shape "
        f"[{found.unit}], over time [s]."
    )


def _rank_legend(report: ShapeReport) -> str:
    """Return the legend of the curves of `_rank_plots` and `_track_rank_plots`."""
    sentences = []
    if report.found.curve is not None:
        sentences.append(f"Over the number K of basis shapes including the mean: {report.found.curve.measure}.")
        sentences.append(_choice_text(report.found, report.found.curve))
    if any(len(curve) > 1 for curve in report.track_curves):
        sentences.append("Over the rank of the tracks without the translation: RMS error of held-out positions [px].")
    return " ".join(sentences)


def _choice_text(found: RecoveredShapes, curve: RankCurve) -> str:
    """Return how to read the choice of the number of basis shapes, and whether fewer would do nearly as well."""
    tested = ", ".join(map(str, curve.ranks))
    text = f"Lower is better; {tested} were tested, and the dashed line marks the chosen number."
    order = np.argsort(curve.ranks)
    errors, ranks = curve.errors[order], curve.ranks[order]
    whole = errors[0] - errors.min()
    enough = ranks[np.argmax(errors[0] - errors >= _ENOUGH * whole)] if whole > 0 else ranks[0]
    if enough < found.basis_shapes:
        share = 100 * _ENOUGH
        text += f" {count_of(int(enough), 'basis shape')} already give {share:.0f} % of the decrease or more, so that "
        text += "the number is not certain."
    return text


def _rank_plots(found: RecoveredShapes) -> list[CurvePlot]:
    curve = found.curve
    if curve is None or len(curve.ranks) < 2:
        return []
    title = f"basis shapes: {found.basis_shapes} were chosen"
    plot = _over_ranks(title, curve.ranks.astype(float), curve.errors, curve.errors_sd, "")
    return [replace(plot, marks=[PlotMark(at=float(found.basis_shapes), colour=COLOURS[1])])]


def _track_rank_plots(report: ShapeReport) -> list[CurvePlot]:
    return [
        _over_ranks(f"{name}: rank of the tracks", curve[:, 0], curve[:, 1], np.full(len(curve), np.nan), " px")
        for name, curve in zip(report.views, report.track_curves, strict=False)
        if len(curve) > 1
    ]


def _over_ranks(title: str, ranks: Floats, errors: Floats, sd: Floats, unit: str) -> CurvePlot:
    """Return a plot of errors over ranks, interpolated linearly between the tested ranks."""
    axis = np.arange(ranks.min(), ranks.max() + 1)
    line = Trace(label="error", values=np.interp(axis, ranks, errors), sd=np.interp(axis, ranks, sd), colour=COLOURS[0])
    spread = float(np.ptp(errors))
    return CurvePlot(title=title, curves=[line], unit=unit, least=0.0, digits=_digits(spread), axis=axis)


def _digits(value: float) -> int:
    return int(np.clip(2 - np.floor(np.log10(max(value, 1e-9))), 0, 8))


def _frame_plots(report: ShapeReport) -> list[CurvePlot]:
    found = report.found
    seen = np.isfinite(found.residuals)
    squares = np.where(seen, found.residuals, 0) ** 2
    count = seen.sum(2)
    rms = np.where(count > 0, np.sqrt(squares.sum(2) / np.maximum(count, 1)), np.nan)
    sd = np.sqrt(np.nanmean(np.where(found.answered[:, None, None], found.shape_sd, 0) ** 2, axis=2))
    sd = np.where(found.answered[:, None], sd, np.nan)
    names = report.views or ("residual",)
    digits = _digits(float(np.nanmedian(rms)))
    curves = [
        Trace(label=n, values=r, colour=COLOURS[k % len(COLOURS)])
        for k, (n, r) in enumerate(zip(names, rms, strict=True))
    ]
    axes = [Trace(label=f"sd along {a}", values=sd[:, k], colour=COLOURS[k]) for k, a in enumerate("xyz")]
    return [
        CurvePlot(title="points seen", unit="", least=2.0, digits=0, curves=[
            Trace(label="seen", values=seen.any(0).sum(1).astype(float), colour=COLOURS[0])]),
        CurvePlot(
            title="residual, RMS" + (" by camera" if len(names) > 1 else ""), unit="", least=0.0, digits=digits,
            curves=curves,
        ),
        CurvePlot(
            title="sd of the shape along x, y, z", unit="", least=0.0, curves=axes,
            digits=_digits(float(np.nanmedian(sd))),
        ),
    ]  # fmt: skip


def _coefficient_plots(found: RecoveredShapes) -> list[CurvePlot]:
    """Return plots of the first coefficients; that of the mean is always 1."""
    shown = found.coefficients[:, 1 : 1 + _MOST_COEFFICIENTS]
    return [
        CurvePlot(
            title=f"basis shape {k + 2}", unit="", least=0.0, digits=_digits(float(np.nanstd(values))),
            curves=[Trace(label="coefficient", values=values, colour=COLOURS[0])],
        )
        for k, values in enumerate(shown.T)
    ]  # fmt: skip


def _turn_plots(found: RecoveredShapes) -> list[CurvePlot]:
    answered = np.flatnonzero(found.answered)
    turn = np.full((len(found), 3), np.nan)
    turn[answered] = np.degrees(rotations.log(found.rotation[answered] @ found.rotation[answered[0]].T))
    sd = np.degrees(found.rotation_sd)
    return [
        CurvePlot(
            title=f"about {axis}", curves=[Trace(label="rotation", values=turn[:, k], sd=sd[:, k], colour=COLOURS[k])]
        )
        for k, axis in enumerate("xyz")
    ]
