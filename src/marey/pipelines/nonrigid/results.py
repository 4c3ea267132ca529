"""The files of a run on a deforming surface."""

from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.io.shapes.shape_glb import write_shape_glb
from marey.io.shapes.shapes import upright, write_point_clouds, write_residuals, write_shape_c3d, write_shapes
from marey.io.shapes.tracks import write_tracks
from marey.io.video.video_writer import VideoWriter
from marey.nonrigid.recovered import RecoveredShapes
from marey.pipelines.nonrigid.input import NonRigidInput
from marey.pipelines.nonrigid.measure import NonRigidPoints
from marey.pipelines.progress import Progress
from marey.pipelines.run_details import RunDetails, page_head
from marey.pipelines.run_record import finished_together, write_record
from marey.view.pages.html import Still
from marey.view.pages.shape_report import ShapeReport, write_shape_report
from marey.view.pictures.shape_overlay import ShapeOverlay, ShapeScene, near_lines

RESULTS = ("report.html", "shapes.npz", "residuals.csv")
"""Files that every run writes, whose names are checked before the work."""
_STILLS = 4
"""Number of frames of each overlay video in the report."""
_UNKNOWN_AS = 1e-3
"""Length of a unit whose length is unknown, in C3D [m]: files in millimetres then have the values of the shapes."""
_ABOUT_A_METRE = 1.0
"""Size of an object of unknown size in the GLB [m], so that viewers show it at once."""


def write_results(
    given: NonRigidInput, measured: NonRigidPoints, found: RecoveredShapes, details: RunDetails, out: Path,
    progress: Progress, *, overlay: bool,
) -> None:  # fmt: skip
    """Write all files at once.

    Args:
        given: The input.
        measured: The points from which the shapes were recovered.
        found: The shapes.
        details: Settings and inputs of the run.
        out: The folder.
        progress: Progress reporter; its times and warnings are in the report.
        overlay: Whether overlay videos are drawn.
    """
    with finished_together(out, inputs=details.inputs) as folder:
        with progress.stage("Results"):
            write_shapes(
                folder / "shapes.npz", found, labels=measured.labels,
                camera_points=measured.camera_points, probability=measured.probability,
            )  # fmt: skip
            write_residuals(folder / "residuals.csv", found, measured.labels)
            _write_exports(folder, given, measured, found)
            for name, video in zip(given.names, measured.videos, strict=False):
                several = len(measured.videos) > 1
                write_tracks(folder / (f"tracks_{name}.npz" if several else "tracks.npz"), video.found)
        stills = _write_overlays(folder, given, measured, found, progress) if overlay else []
        with progress.stage("Report"):
            _write_report(folder, given, measured, found, details, stills, progress)
        write_record(
            folder, command=details.command, settings=details.settings, inputs=details.inputs, root=details.root,
            progress=progress, verdict=details.verdict,
        )  # fmt: skip


def _write_exports(folder: Path, given: NonRigidInput, measured: NonRigidPoints, found: RecoveredShapes) -> None:
    """Write the files for other programs, in metres if a length is known."""
    known = bool(np.isfinite(found.metres_per_unit))
    unit = "m" if known else found.unit
    y_up = bool(given.data) and given.data[0].y_up
    size = 2 * float(np.sqrt(np.nanmean((found.basis[0] ** 2).sum(0))))
    write_point_clouds(
        folder / "shapes", found, measured.edges, scale=found.metres_per_unit if known else 1.0, unit=unit
    )  # fmt: skip
    write_shape_glb(
        folder / "shapes.glb", found, measured.edges, rate=given.rate, y_up=y_up, unit=found.unit,
        scale=found.metres_per_unit if known else _ABOUT_A_METRE / max(size, 1e-12),
    )  # fmt: skip
    write_shape_c3d(
        folder / "shapes.c3d", found, measured.labels, rate=given.rate,
        scale=found.metres_per_unit if known else _UNKNOWN_AS,
    )  # fmt: skip


def _write_overlays(
    folder: Path,
    given: NonRigidInput,
    measured: NonRigidPoints,
    found: RecoveredShapes,
    progress: Progress,
) -> list[Still]:
    """Draw one overlay video per camera, and return some of its frames; nothing is drawn without videos."""
    stills = []
    for number, clip in enumerate(given.clips):
        scene = ShapeScene(
            name=given.names[number], measured=_tracks_of(measured, number), modelled=found.modelled[number],
            placed=_before(given, found, number), lines=_lines(measured, found),
        )  # fmt: skip
        overlay = ShapeOverlay(scene, clip.size)
        answered = np.flatnonzero(found.answered)
        shown = set(answered[np.linspace(0, len(answered) - 1, _STILLS).astype(int)].tolist())
        frames = range(given.first, given.end)
        with (
            progress.stage(f"Overlay {scene.name}", len(frames)) as step,
            VideoWriter(folder / f"overlay_{scene.name}.mp4", overlay.size, rate=given.rate) as video,
        ):
            for frame, image in zip(frames, clip.images(frames), strict=True):
                drawn = overlay.draw(image, frame)
                video.add(drawn)
                if frame in shown:
                    stills.append(Still(caption=f"{scene.name}, frame {frame}", image=drawn))
                step()
    return stills


def _tracks_of(measured: NonRigidPoints, camera: int) -> Floats:
    assert measured.tracks is not None
    return np.asarray(measured.tracks[camera])


def _before(given: NonRigidInput, found: RecoveredShapes, camera: int) -> Floats:
    """Return the shapes (F, 3, P) in the axes of one camera."""
    if given.rig is not None:
        to_camera = given.rig.cameras[camera].camera_from_world
        return np.moveaxis(to_camera.apply(np.moveaxis(found.placed, 1, 2)), 2, 1)
    if found.cameras is None:
        return found.placed
    return np.asarray(found.cameras.camera_from_first[camera] @ found.rotation @ found.shape)


def _lines(measured: NonRigidPoints, found: RecoveredShapes) -> np.ndarray:
    return measured.edges if len(measured.edges) else near_lines(found.basis[0])


def _write_report(
    folder: Path, given: NonRigidInput, measured: NonRigidPoints, found: RecoveredShapes, details: RunDetails,
    stills: list[Still], progress: Progress,
) -> None:  # fmt: skip
    y_up = bool(given.data) and given.data[0].y_up
    names = [path.name + ("/" if path.is_dir() else "") for path in folder.iterdir()]
    report = ShapeReport(
        title=given.title, found=found, rate=given.rate, labels=measured.labels,
        lines=_lines(measured, found), own_lines=bool(len(measured.edges)), upright=upright(found, y_up=y_up),
        views=given.names, notes=progress.warnings, stills=stills, timings=progress.timings,
        settings=details.settings, files=names, head=page_head(details.command, details.verdict),
        track_curves=[video.curve for video in measured.videos],
    )  # fmt: skip
    write_shape_report(folder / "report.html", report)
