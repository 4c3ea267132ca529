"""The report of a calibration: cameras and boards in space, coverage, errors, findings and what to film next."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.calibration.adjustment.lens_choice import LENS_MODELS, LensChoice
from marey.calibration.adjustment.solve import LeftOut
from marey.calibration.adjustment.state import SessionState
from marey.calibration.boards.corners import CornerSet
from marey.calibration.boards.wand import CalibrationTarget, CalibrationWand
from marey.calibration.quality.finding import Finding, left_out_text
from marey.calibration.quality.views import COVERAGE, CameraQuality, ViewQuality
from marey.calibration.quality.volume import VolumeAccuracy
from marey.calibration.quality.world import centres
from marey.calibration.timing.wand_clocks import StatedDelay
from marey.io.atomic import replacing
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
from marey.view.pictures.calibration_picture import coverage_picture, volume_picture

FILES = {
    "cameras.toml": "the cameras, as marey capture, Pose2Sim and Anipose read them",
    "calibration.json": "covariances, errors by camera and picture, coverage, findings, predicted accuracy",
    "run.json": "version, settings, inputs, timings",
}
"""Files beside the report and their content."""
_MEANING = {
    "Residual": "Distance of a measured corner of the board, or point of the wand, from where the adjusted cameras and "
    "their common pose predict it.",
    "Standard deviations": "From the covariance of the joint adjustment: how far the estimates would scatter if the "
    "session were filmed again. Errors common to a whole picture, for example by motion blur, are included where they "
    "can be detected.",
    "Point in space": "Standard deviation (all three directions together) of a point that is seen without error by all "
    "cameras in whose images it lies, due to the uncertainty of the cameras alone.",
    "Coverage": "Share of the 48 cells of an image in which the board was seen. In the others the lens is "
    "extrapolated.",
    "Pictures of a camera": "Those in which corners were measured and used. A first search finds boards without any "
    "knowledge of the cameras. A second one, by the calibration so far, also measures boards that the first missed, "
    "and leaves out those whose print cannot be recognised well enough. Pictures of a board at rest count as one.",
    "Left out": "Pictures in which too few corners can be measured, or which contradict the others, are not used; each "
    "is named with its reason. Of two views that contradict each other both are left out, also the one that lies near "
    "its prediction, since neither is known to be right.",
}
"""Explanations of the terms on the page."""
_MOST_BOARDS = 150
"""Number of board poses that the scene shows at most; chosen by hand."""
_MOST_LEFT_OUT = 40
"""Number of rows of the table of pictures that were left out; calibration.json has all. Chosen by hand."""
_LAYERS = (0.1, 1.0, 1.8)
"""Heights of the layers of the capture volume that are drawn [m]; chosen by hand."""
_LEGEND = (
    "Cameras with their fields of view, the poses of the board in blue, that on the floor in orange. The axes of the "
    "world are x (red), y (green) and z (blue), one metre long. Points are coloured by their predicted standard "
    "deviation, green is accurate."
)
"""Legend of the scene."""

_CAMERAS_LEGEND = (
    "± are standard deviations; poses in the world. Pictures are those in which corners were measured and used, not "
    "those of the first search. Tilt: angle between the board's normal and the direction to the camera; "
    "distance: from the camera to the board's centre."
)
"""Legend of the table of cameras."""
_LENS_LEGEND = (
    "Which distortion coefficients were chosen for each lens; none: straight lines stay straight. Each further column "
    "is a possible choice. Its number states how much worse it describes the corners than the last column does "
    "(chi-square); small numbers are good. The least sum of this number and of a cost of each coefficient is chosen: "
    "at least 2, more with many pictures, and at least 9 for k3. Pictures that add little count as less than one."
)
"""Legend of the table of lens models."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibrationReport:
    """Content of the report of a calibration."""

    title: str
    state: SessionState
    corners: CornerSet
    """The corners that were used."""
    residual: Floats
    """(N, 2) measured minus predicted [px]."""
    board: CalibrationTarget
    cameras: Sequence[CameraQuality]
    volume: VolumeAccuracy
    views: ViewQuality
    findings: Sequence[Finding]
    left_out: Sequence[LeftOut]
    world: str
    """What sets the world: floor, points, level with the cameras, or none."""
    together: bool
    """Whether the cameras recorded at the same time."""
    timings: Mapping[str, float] = field(default_factory=dict)
    settings: Mapping[str, object] = field(default_factory=dict)
    head: PageHead = field(default_factory=PageHead)
    choices: Sequence[LensChoice | None] = ()
    """Choice of the model of each lens; empty if models were not compared."""
    delays: Sequence[StatedDelay] = ()
    """Delays of cameras that were estimated with a wand."""
    clock: str | None = None
    """The camera whose clock counts for them."""


def write_calibration_report(path: Path, report: CalibrationReport) -> None:
    """Write calibration.html.

    Args:
        path: The file.
        report: The content of the report.
    """
    with replacing(path) as beside:
        beside.write_text(calibration_html(report), encoding="utf-8")


def calibration_html(report: CalibrationReport) -> str:
    """Return the page as one HTML document that loads nothing from elsewhere."""
    content = CurvesContent(
        kind="Calibration of cameras", title=report.title,
        time=np.arange(max(len(report.corners.pictures), 1), dtype=float),
        tiles=_tiles(report), notes=_notes(report.left_out), tables=_tables(report), groups=_groups(report),
        stills=_stills(report), timings=report.timings, settings=report.settings, files=FILES, meaning=_MEANING,
        head=report.head,
    )  # fmt: skip
    data = curves_data(content, stride_of(len(content.time))) | {"rig": _scene(report)}
    # The verdict at the head of the page lists problems and cautions already.
    further = [each for each in report.findings if not report.head.has_reason(each.text)]
    return rendered(
        "calibration.html", content, data=data, findings=[each.severity for each in further],
        advice=[(each.severity, each.text, each.advice) for each in further], some=bool(report.findings),
        replay_legend=_LEGEND,
    )  # fmt: skip


def _notes(left_out: Sequence[LeftOut]) -> list[str]:
    pictures = sum(each.camera is None for each in left_out)
    text = left_out_text(pictures, len(left_out) - pictures)
    return [f"Left out: {text}; the table states the reasons."] if left_out else []


def _tiles(report: CalibrationReport) -> list[tuple[str, str, str]]:
    used = [each for each in report.cameras if each.corners]
    median = float(np.median([each.rms_px for each in used])) if used else float("nan")
    focal = max((100 * each.lens_sd[0] / each.lens[0] for each in used), default=float("nan"))
    moved = "wand" if isinstance(report.board, CalibrationWand) else "board"
    tiles = [
        ("cameras", f"{len(used)}", f"of {len(report.cameras)} saw the {moved}"),
        ("residual", f"{median:.2f} px", "RMS, median over the cameras"),
        ("focal length", f"{focal:.2f} %", "largest standard deviation"),
    ]
    if report.together:
        place = max((each.relative_position_sd_mm for each in used), default=float("nan"))
        turn = max((each.relative_rotation_sd_deg for each in used), default=float("nan"))
        known = report.volume.sd[np.isfinite(report.volume.sd)]
        space = f"{1e3 * np.median(known):.2f} mm" if len(known) else "-"
        tiles += [
            ("position", f"{place:.2f} mm", "largest standard deviation, between the cameras"),
            ("rotation", f"{turn:.3f} °", "largest standard deviation, between the cameras"),
            ("point in space", space, "median standard deviation in the capture volume"),
        ]
    texts = {
        "floor": ("world", "floor", "board on the floor"), "points": ("world", "points", "known coordinates"),
        "none": ("world", "none", "lenses only"),
    }  # fmt: skip
    assumed = ("floor", "not measured", "horizontal assumed from the cameras")
    return [*tiles, texts.get(report.world, assumed)]


def _tables(report: CalibrationReport) -> list[NumberTable]:
    head = ("camera", "pictures", "corners", "RMS px", "covered %", "tilt °", "distance m", "fx px", "± px",
            "cx px", "± px", "cy px", "± px", "rotation ± °", "position ± mm")  # fmt: skip
    rows = [
        (each.name, str(each.pictures), str(each.corners), f"{each.rms_px:.3f}", f"{100 * each.covered:.0f}",
         _range(each.tilt_deg, 0), _range(each.distance_m, 1),
         f"{each.lens[0]:.2f}", f"{each.lens_sd[0]:.2f}", f"{each.lens[2]:.2f}", f"{each.lens_sd[2]:.2f}",
         f"{each.lens[3]:.2f}", f"{each.lens_sd[3]:.2f}", f"{each.rotation_sd_deg:.3f}", f"{each.position_sd_mm:.2f}")
        for each in report.cameras
    ]  # fmt: skip
    tables = [
        NumberTable(title="Cameras", head=head, rows=rows, legend=_CAMERAS_LEGEND)
    ]
    if report.choices:
        tables.append(_lens_table(report))
    if report.delays:
        tables.append(_clock_table(report))
    if report.left_out:
        named = [
            (report.corners.pictures[each.picture], 
             "all" if each.camera is None else report.corners.cameras[each.camera], each.reason)
            for each in report.left_out[:_MOST_LEFT_OUT]
        ]  # fmt: skip
        more = len(report.left_out) - len(named)
        tables.append(
            NumberTable(title="Left out", head=("picture", "camera", "reason"), rows=named, text_columns=(0, 1, 2),
                        legend=f"And {more} more." if more else "")
        )  # fmt: skip
    return tables


def _range(ends: tuple[float, float], digits: int) -> str:
    """Return two ends as a text; a dash where they are not known, as the tilt of a wand."""
    return f"{ends[0]:.{digits}f} to {ends[1]:.{digits}f}" if np.isfinite(ends).all() else "-"


def _lens_table(report: CalibrationReport) -> NumberTable:
    head = ("camera", "chosen", "effective pictures", *(" ".join(model) or "none" for model in LENS_MODELS))
    rows = [
        (name, (" ".join(choice.coefficients) or "none") + (" (given)" if choice.fixed else ""),
         f"{choice.pictures:.0f}", *(f"{each.chi_square:.1f}" for each in choice.evidence))
        for name, choice in zip(report.corners.cameras, report.choices, strict=True)
        if choice is not None
    ]  # fmt: skip
    return NumberTable(title="Distortion of the lenses", head=head, rows=rows, text_columns=(0, 1), legend=_LENS_LEGEND)


def _clock_table(report: CalibrationReport) -> NumberTable:
    rows = [
        (report.corners.cameras[each.camera], f"{each.pictures:+.4f}" if each.known else "-",
         f"{1.96 * each.sd:.4f}" if each.known else "-",
         f"{each.drift:+.4f} ± {1.96 * each.drift_sd:.4f}" if each.drift else "none",
         "not determined" if not each.known else "allowed for" if each.used else "in step")
        for each in report.delays
    ]  # fmt: skip
    return NumberTable(
        title="Clocks", head=("camera", "late, pictures", "± (95 %)", "drift, pictures", "use"), rows=rows,
        text_columns=(0, 3, 4),
        legend=f"By how much each camera is later than {report.clock}, from the motion of the wand, in the middle of "
        "the session; and the change from its first picture to the last. A delay that does not exceed its uncertainty "
        "is not used: the camera counts as in step.",
    )  # fmt: skip


def _groups(report: CalibrationReport) -> list[PlotGroup]:
    plots = []
    for camera, name in enumerate(report.corners.cameras):
        values = np.full(len(report.corners.pictures), np.nan)
        own = report.views.camera == camera
        values[report.views.picture[own]] = report.views.error_px[own]
        if np.isfinite(values).sum() > 1:
            curve = Trace(label=name, values=values, colour=COLOURS[camera % len(COLOURS)])
            plots.append(CurvePlot(title=name, unit=" px", least=0.05, digits=2, curves=[curve]))
    legend = "RMS residual [px] of each picture, by its number."
    return [PlotGroup(title="Errors by picture", plots=plots, legend=legend)]


def _stills(report: CalibrationReport) -> list[Still]:
    stills = []
    for camera, name in enumerate(report.corners.cameras):
        own = report.corners.camera == camera
        image = coverage_picture(
            report.corners.pixels[own], np.nan_to_num(report.residual[own]), report.corners.sizes[camera], COVERAGE
        )  # fmt: skip
        covered = 100 * report.cameras[camera].covered
        stills.append(Still(caption=f"{name}: {covered:.0f} % of the image covered", image=image))
    if len(report.volume.points):
        known = report.world in ("floor", "points")
        for height in _LAYERS if known else (float(np.median(report.volume.points[:, 2])),):
            image = volume_picture(report.volume.points, 1e3 * report.volume.sd, height)
            stills.append(
                Still(caption=f"Standard deviation of points near z = {height:.1f} m, from above [mm]", image=image)
            )
    return stills


def _scene(report: CalibrationReport) -> dict[str, object]:
    """Return what the scene shows: cameras, board outlines and points with their accuracy."""
    state = report.state
    pictures = np.unique(report.corners.picture[report.corners.corner < len(report.board.points)])
    shown = pictures[np.unique(np.linspace(0, len(pictures) - 1, min(len(pictures), _MOST_BOARDS)).astype(int))]
    width, height = report.board.extent
    outline = np.array([[0, 0, 0], [width, 0, 0], [width, height, 0], [0, height, 0]])
    places = outline @ state.board_rotation[shown].transpose(0, 2, 1) + state.board_translation[shown][:, None]
    level = (np.abs(state.board_rotation[shown, 2, 2] + 1) < 1e-6) & (report.world == "floor")
    middle = places.reshape(-1, 3).mean(axis=0) if len(shown) else np.zeros(3)
    reach = np.linalg.norm(centres(state) - middle, axis=1).max() if report.together else 1.0
    sd = 1e3 * report.volume.sd
    good = np.isfinite(sd)
    cameras = [
        {
            "name": name, "size": list(size), "rotation": state.camera_rotation[k].tolist(),
            "translation": state.camera_translation[k].tolist(),
            "focal": state.lens[k, :2].tolist(), "centre": state.lens[k, 2:4].tolist(),
        }
        for k, (name, size) in enumerate(zip(report.corners.cameras, report.corners.sizes, strict=True))
    ]  # fmt: skip
    return {
        "cameras": cameras if report.together else cameras[:1], "boards": packed(places, "f4"), "count": len(shown),
        "floor": packed(level, "u1"), "points": packed(report.volume.points[good], "f4"), "sd": packed(sd[good], "f4"),
        "middle": middle.tolist(), "reach": float(max(reach, 0.5)),
    }  # fmt: skip
