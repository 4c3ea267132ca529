"""The report of a measured surface: points and residuals by frame, trajectories, corrected cameras."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.cameras.rig import Rig
from marey.io.atomic import replacing
from marey.surface.points.measured import MeasuredPoints
from marey.surface.points.refine_rig import RigRefinement
from marey.surface.tracks.filters import Filtered
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
from marey.view.pages.html import PageHead, Still, files_beside, packed, rendered

FILES = {
    "surface.npz": "all points with covariance, pixels, correlations and residual",
    "surface.ply": "coloured points of the first frame with points, for any viewer",
    "surface/": "coloured points of each frame (PLY)",
    "surface_<camera>.png": "depth of the points in the template image, and the surface lit from the side",
    "trajectories.npz": "points followed through the frames",
    "tracks_<camera>.png": "velocities of the followed points over an image",
    "corrected_cameras.toml": "the cameras as the matches correct them",
    "run.json": "version, settings, inputs, timings",
}
"""Files that can lie beside the report, and their content."""
_MEANING = {
    "Points": "Patches of a template image that were matched in at least one other image and whose rays intersect.",
    "Residual": "Root mean square distance between the pixels of a point and its projections. With three rays, errors "
    "in every direction are visible; with two, only errors perpendicular to the epipolar line, and no depth errors.",
    "Standard deviation": "Square root of the trace of the covariance of a point in space. It includes image noise, "
    "the observed residuals, and the bias due to the curvature of the surface under the patch.",
    "Trajectories": "Points of skin or cloth that were followed from frame to frame, after the rejection of false "
    "ones.",
}
"""Explanations of the terms on the page."""
_BINS = 60
"""Number of bins of a histogram; chosen by hand."""
_SHOWN = 0.99
"""Share of the points within the range of a histogram; chosen by hand."""
_MOST_ROWS = 24
"""Number of rows of a table at most; chosen by hand."""


_MOST_SHOWN = 150_000
"""Number of points of the 3-D view at most, about 1.8 MB. Chosen by hand for small files."""
_FEWEST_IN_FRAME = 5000
"""Number of points in each frame of the 3-D view at that limit; of more frames not every one is shown. Chosen by eye on
a face."""
_STEPS = 65535
"""Largest coded coordinate: 16 bits."""
_VIEW_FROM_CAMERA = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Rotation from a camera's axes (x right, y down, z ahead) to those of the view, whose Z is up and Y ahead."""
_SCENE_LEGEND = (
    "Shown are {count:,} of all {whole:,} points, in {where}{kept}; surface.npz contains all. The colours are those of "
    "the images, the vertical is that of the image of {camera}."
)
"""Legend of the 3-D view."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SurfaceReport:
    """Content of the report of a measured surface."""

    title: str
    parts: Sequence[MeasuredPoints]
    """Measured points of each frame, from the first frame on; at least one frame has points."""
    first: int
    """Number of the first frame."""
    rate: float
    rig: Rig
    refined: RigRefinement | None = None
    followed: Filtered | None = None
    stills: Sequence[Still] = ()
    notes: Sequence[str] = ()
    timings: Mapping[str, float] = field(default_factory=dict)
    settings: Mapping[str, object] = field(default_factory=dict)
    head: PageHead = field(default_factory=PageHead)


def write_surface_report(path: Path, report: SurfaceReport) -> None:
    """Write surface.html.

    Args:
        path: The file; the other results of the run are beside it.
        report: The content of the report.
    """
    gathered = _gathered(report.parts)
    frames, plots = gathered.frames, _histograms(report, gathered)
    over_time, histograms = _legends(report)
    groups = [PlotGroup(title="Residuals and standard deviations", plots=plots, legend=histograms)]
    if len(report.parts) > 1:
        groups.insert(0, PlotGroup(title="Frame by frame", plots=_curves(report, frames), legend=over_time))
    tables = [_frame_table(report, frames)]
    if report.refined is not None:
        tables.insert(0, _camera_table(report.rig, report.refined))
    content = CurvesContent(
        kind="Measured surface", title=report.title, time=(report.first + np.arange(len(report.parts))) / report.rate,
        tiles=_tiles(report, frames), notes=report.notes, tables=tables, groups=groups, stills=report.stills,
        timings=report.timings, settings=report.settings, meaning=_MEANING, head=report.head,
        files=files_beside(FILES, [each.name for each in path.parent.iterdir()]),
    )  # fmt: skip
    with replacing(path) as temporary:
        temporary.write_text(_with_scene(content, report), encoding="utf-8")


def _with_scene(content: CurvesContent, report: SurfaceReport) -> str:
    """Return the page with its 3-D view."""
    stride = stride_of(len(report.parts))
    data = curves_data(content, stride) | {"first": report.first, "rate": report.rate, "stride": stride}
    shown = _shown_points(report.parts)
    count, whole = sum(map(len, shown.values())), sum(map(len, report.parts))
    every = sum(len(report.parts[k]) for k in shown)
    one = f"frame {report.first + next(iter(shown))}"
    where = one if len(shown) == 1 else f"{len(shown)} of {len(report.parts)} frames"
    kept = "" if count == every else f", selected evenly from the {every:,} there"
    scene = _scene(shown, report)
    legend = _SCENE_LEGEND.format(count=count, whole=whole, where=where, kept=kept, camera=scene["camera"])
    return rendered(
        "surface.html", content, data=data | {"surface": scene}, replay_legend=legend, still=len(report.parts) == 1
    )  # fmt: skip


def _shown_points(parts: Sequence[MeasuredPoints]) -> dict[int, MeasuredPoints]:
    """Choose the points of the 3-D view, by the number of the part: evenly of all frames with points, and of each."""
    filled = [k for k, part in enumerate(parts) if len(part)]
    most = _MOST_SHOWN // _FEWEST_IN_FRAME
    frames = [filled[i] for i in np.unique(np.linspace(0, len(filled) - 1, min(len(filled), most)).astype(int))]
    share = min(1.0, _MOST_SHOWN / sum(len(parts[k]) for k in frames))
    chosen = {}
    for k in frames:
        wanted = max(1, int(share * len(parts[k])))
        chosen[k] = parts[k][np.linspace(0, len(parts[k]) - 1, wanted).astype(int)]
    return chosen


def _scene(shown: Mapping[int, MeasuredPoints], report: SurfaceReport) -> dict[str, object]:
    """Return the data of the 3-D view: points as the camera sees them whose images were the template of most."""
    templates = np.concatenate([part.template for part in shown.values()])
    camera = report.rig.cameras[int(np.argmax(np.bincount(templates)))]
    turn = _VIEW_FROM_CAMERA @ camera.camera_from_world.rotation
    places = np.concatenate([part.points for part in shown.values()]) @ turn.T
    middle = np.median(places, axis=0)
    size = max(float(np.percentile(np.linalg.norm(places - middle, axis=1), 98)), 1e-9)
    places = (places - middle) / size
    low = places.min(0)
    step = max(float((places.max(0) - low).max()) / _STEPS, 1e-12)
    ends = np.cumsum([len(part) for part in shown.values()])[:-1]
    return {
        "camera": camera.name, "low": low.tolist(), "step": step, "frames": list(shown),
        "of": [len(report.parts[k]) for k in shown],
        "places": [packed(np.round((each - low) / step), "u2") for each in np.split(places, ends)],
        "colours": [packed(part.colour, "u1") for part in shown.values()],
    }  # fmt: skip


_OVER_TIME = "Number of points in each frame, and the medians of their residuals [px] and standard deviations [mm]"
"""Legend of the curves over time, without its end."""
_HISTOGRAMS = "Share of the points [%] by residual [px] and by standard deviation [mm]"
"""Legend of the histograms, without its end."""


def _legends(report: SurfaceReport) -> tuple[str, str]:
    """Return the legends of the curves over time and of the histograms."""
    if report.followed is None:
        return f"{_OVER_TIME}, over time [s].", f"{_HISTOGRAMS}."
    lengths = "share of the trajectories [%] by length [frames]"
    return f"{_OVER_TIME}, and the number of points that are followed, over time [s].", f"{_HISTOGRAMS}; {lengths}."


def _spread_mm(points: MeasuredPoints) -> Floats:
    return np.asarray(1e3 * np.sqrt(np.trace(points.covariance, axis1=1, axis2=2)))


@dataclass(frozen=True, eq=False)
class _Gathered:
    """Statistics of all frames, collected in one pass."""

    frames: Floats
    """(F, 4): number of points, share with three views or more [%], median residual [px], median sd [mm]; NaN without
    points."""
    residual: Floats
    """(N,) of all points [px]."""
    spread: Floats
    """(N,) [mm]."""


def _gathered(parts: Sequence[MeasuredPoints]) -> _Gathered:
    frames: list[tuple[float, ...]] = []
    residual: list[Floats] = [np.zeros(0)]
    spread: list[Floats] = [np.zeros(0)]
    for part in parts:
        if not len(part):
            frames.append((0.0, np.nan, np.nan, np.nan))
            continue
        residual.append(part.residual_px)
        spread.append(_spread_mm(part))
        several = 100 * np.mean(part.views > 2)
        frames.append((len(part), float(several), float(np.median(residual[-1])), float(np.median(spread[-1]))))
    return _Gathered(np.array(frames, float), np.concatenate(residual), np.concatenate(spread))


def _tiles(report: SurfaceReport, frames: Floats) -> list[tuple[str, str, str]]:
    """Return the key figures: label, value, and the line below."""
    filled = frames[frames[:, 0] > 0]
    middle = np.median(filled, axis=0)
    tiles = [
        ("points", f"{int(frames[:, 0].sum()):,}", f"in {len(filled)} of {len(frames)} frames"),
        ("three views", f"{middle[1]:.0f} %", "of the points are matched in three cameras or more"),
        ("residual", f"{middle[2]:.2f} px", "of a typical point (median)"),
        ("standard deviation", f"{middle[3]:.2f} mm", "of a typical point in space (median)"),
        (
            "cameras",
            str(len(report.rig)),
            "corrected by the matches" if report.refined is not None else "as calibrated",
        ),
    ]
    if report.followed is not None:
        tracks = report.followed.trajectories
        long = tracks.measured[:, tracks.kept].sum(axis=0)
        below = f"over {long.mean():.1f} frames on average" if len(long) else "no point could be followed"
        tiles.append(("trajectories", f"{len(tracks.kept):,}", below))
    return tiles


def _curves(report: SurfaceReport, frames: Floats) -> list[CurvePlot]:
    """Return plots of the statistics over time."""
    what = (("points", "", 0, 10.0, 0), ("residual, median", " px", 2, 0.05, 2), ("sd, median", " mm", 3, 0.05, 2))
    plots = [
        CurvePlot(title=title, unit=unit, least=least, digits=digits,
                  curves=[Trace(label=title, values=frames[:, column], colour=COLOURS[0])])
        for title, unit, column, least, digits in what
    ]  # fmt: skip
    if report.followed is not None:
        tracks = report.followed.trajectories
        rows = tracks.measured[:, tracks.kept].sum(axis=1)[report.first : report.first + len(report.parts)]
        curve = Trace(label="followed", values=rows.astype(float), colour=COLOURS[2])
        plots.append(CurvePlot(title="points followed", unit="", least=10.0, digits=0, curves=[curve]))
    return plots


def _histograms(report: SurfaceReport, gathered: _Gathered) -> list[CurvePlot]:
    """Return histograms of residuals, standard deviations and lengths of trajectories."""
    plots = [
        _histogram("residual", "px", gathered.residual), _histogram("standard deviation", "mm", gathered.spread)
    ]  # fmt: skip
    if report.followed is not None and len(report.followed.trajectories.kept):
        tracks = report.followed.trajectories
        plots.append(_histogram("length of trajectories", "frames", tracks.measured[:, tracks.kept].sum(axis=0)))
    return plots


def _histogram(title: str, unit: str, values: Floats) -> CurvePlot:
    counts, edges = np.histogram(values, _BINS, (0.0, max(float(np.quantile(values, _SHOWN)), 1e-9)))
    share = Trace(label=unit, values=100 * counts / len(values), colour=COLOURS[0])
    return CurvePlot(
        title=f"{title} [{unit}]", unit=" %", least=1.0, curves=[share], axis=0.5 * (edges[1:] + edges[:-1])
    )  # fmt: skip


def _frame_table(report: SurfaceReport, frames: Floats) -> NumberTable:
    """Return a table of frames, evenly selected from a long take."""
    shown = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), _MOST_ROWS)).astype(int))
    rows = [
        (str(report.first + k), f"{int(frames[k, 0]):,}", *("" if v != v else f"{v:.{d}f}" for v, d in
         zip(frames[k, 1:], (0, 2, 2), strict=True)))
        for k in shown
    ]  # fmt: skip
    head = ("frame", "points", "three views %", "residual px", "sd mm")
    return NumberTable(title="Frames", head=head, rows=rows, legend="Medians; empty cells have no points.")


def _camera_table(rig: Rig, refined: RigRefinement) -> NumberTable:
    """Return a table of the corrections of the cameras."""
    rows = [
        (name, f"{np.degrees(rotation):.3f}", f"{1e3 * shift:.2f}", f"{px:.2f}")
        for name, rotation, shift, px in zip(rig.names, refined.rotation, refined.shift, refined.moved_px, strict=True)
    ]
    legend = (
        f"Estimated from {refined.tuples} matches. The median residual of corresponding rays fell from "
        f"{refined.residual_before:.2f} to {refined.residual_after:.2f} px."
    )
    head = ("camera", "rotation °", "translation mm", "shift of pixels px")
    return NumberTable(title="Cameras corrected", head=head, rows=rows, legend=legend)
