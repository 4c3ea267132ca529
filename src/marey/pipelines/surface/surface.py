"""`marey surface`: from the images of a trial to the points of the visible surface."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.cameras.rig import Rig
from marey.errors import MareyError
from marey.io.calibration.readers import read_rig, write_cameras_toml
from marey.io.shapes.measured_surface import write_ply, write_surface
from marey.io.stages import FrameLog, file_fingerprint
from marey.io.trial.seeds import read_seeds
from marey.io.trial.trial import Trial
from marey.io.video.pictures import write_picture
from marey.pipelines.capture.run import CORRECTED_CAMERAS, require_two_cameras
from marey.pipelines.progress import Progress
from marey.pipelines.result_files import ResultFiles
from marey.pipelines.run_details import page_head
from marey.pipelines.run_record import StageCache, finished_together, write_record
from marey.pipelines.surface.result import Surface
from marey.pipelines.surface.settings import SurfaceOptions
from marey.pipelines.surface.stages import (
    KeptFrames,
    Measurement,
    cause_in_pictures,
    checked_rig,
    measure_frames,
    measurement,
    rig_arrays,
    rig_from,
    why_nothing,
)
from marey.pipelines.surface.tracks import follow_measured, rejection_notes, tracks_text, write_tracks
from marey.pipelines.surface.verdict import surface_verdict, suspicious
from marey.surface.points.measured import MeasuredPoints
from marey.surface.points.refine_rig import RigRefinement
from marey.surface.tracks.filters import Filtered
from marey.view.pages.html import Still
from marey.view.pages.surface_report import SurfaceReport, write_surface_report
from marey.view.pictures.surface_picture import depth_picture, lit_picture
from marey.wording import listed

RESULTS = ("surface.html", "surface.npz", "surface.ply")
"""Files that every run writes, whose names are checked before the work."""
_LEAST_CAMERAS = 3
"""Number of cameras from which the camera poses are corrected by default: two determine the correction too weakly."""


def surface_of_trial(trial: Trial, options: SurfaceOptions, progress: Progress) -> Surface:
    """Measure the surface that the images of a trial show.

    Args:
        trial: The trial, opened with `options.changes()`.
        options: Settings of the run.
        progress: Progress reporter; it keeps timings and warnings.

    Returns:
        The surface, whose files are in `options.out`, or in `marey/` in the trial.

    Raises:
        FileProblem: Something in the trial cannot be used. Frames that were measured before a damaged one are written
            all the same.
        NotUsable: The cameras show no common surface.
        SettingProblem: A setting is impossible.
    """
    settings = options.settings()
    require_two_cameras(trial)
    clicks = None if options.seeds is None else _clicks(options.seeds, trial)
    out = options.out or trial.folder / "marey"
    for note in trial.take.notes:
        progress.warn(note)
    named = [*trial.input_files, *([options.seeds] if options.seeds else [])]
    scope = (trial.rig.names, trial.take.first, trial.take.end, trial.settings.model_dump_json(), settings)
    run = measurement(trial, settings, clicks, progress)
    with StageCache(
        out, [file_fingerprint(path) for path in named], files=[trial.folder, *named], results=RESULTS
    ) as cache:
        refined = _refined(run, options, cache, scope)
        rig = trial.rig if refined is None else refined.rig
        with cache.frames("surface", depends=(scope, refined is not None)) as log:
            _measure(run, rig, cache, log, out, options, refined, scope)
    return Surface(ResultFiles(out))


def _clicks(path: Path, trial: Trial) -> Floats:
    """Read clicked seeds, and return the columns of the cameras in use."""
    every = read_rig(trial.calibration)
    return read_seeds(path, every)[:, [every.names.index(name) for name in trial.rig.names]]


def _refined(run: Measurement, options: SurfaceOptions, cache: StageCache, scope: object) -> RigRefinement | None:
    """Correct the cameras if that is set, or by default if the matches clearly contradict three or more of them."""
    rig = run.trial.rig
    wanted = options.refine_rig
    if wanted is False or (wanted is None and len(rig) < _LEAST_CAMERAS):
        return None
    arrays = cache.arrays("rig", lambda: rig_arrays(checked_rig(run), rig), depends=scope)
    found = rig_from(arrays, rig, run.settings.refinement)
    if found is None:
        if wanted:
            run.progress.warn("Too few matches to correct the cameras: the calibration is used as it is.")
        return None
    return found if wanted or found.significant else None


def _measure(
    run: Measurement, rig: Rig, cache: StageCache, log: FrameLog, out: Path, options: SurfaceOptions,
    refined: RigRefinement | None, scope: object,
) -> None:  # fmt: skip
    """Measure all frames and write the results, also if a damaged frame ends the run."""
    parts = KeptFrames(log, rig.names)
    try:
        measure_frames(run, rig, log)
    except MareyError:
        if any(len(part) for part in parts):
            run.progress.warn(f"Only the {len(parts)} frames before the damaged one were measured.")
            write_results(run, rig, parts, out, options, refined, None)
        raise
    if not any(len(part) for part in parts):
        raise why_nothing(run)
    followed = None
    if options.tracks and len(parts) > 1:
        depends = (scope, refined is not None)
        take = run.trial.take
        followed = follow_measured(take, rig, parts, cache, run.progress, filters=options.filters(), depends=depends)
    write_results(run, rig, parts, out, options, refined, followed)


def write_results(
    run: Measurement,
    rig: Rig,
    parts: Sequence[MeasuredPoints],
    out: Path,
    options: SurfaceOptions,
    refined: RigRefinement | None,
    followed: Filtered | None,
) -> None:
    """Write all results at once, and report their main figures."""
    trial, progress = run.trial, run.progress
    effective: dict[str, object] = {
        **trial.settings.model_dump(mode="json", exclude_none=True),
        "spacing_px": run.settings.spacing, "patch_px": run.settings.patch,
        "seeds": options.seeds, "compared": [_named(rig, *each) for each in run.compared],
        "rig_correction": None if refined is None else correction(rig, refined),
    }  # fmt: skip
    wanted = trial.take.end - trial.take.first
    third = all(len(searched) > 1 for _, searched in run.compared)
    causes = cause_in_pictures(run, suspicious=suspicious(parts, third=third))
    verdict = surface_verdict(
        rig, parts, wanted, refined=refined, followed=followed, third=third, causes=causes
    )  # fmt: skip
    with finished_together(out) as folder:
        with progress.stage("Results"):
            with ThreadPoolExecutor(1) as beside:
                # Most of the time is compression, which releases Python's lock.
                written = beside.submit(write_surface, folder / "surface.npz", parts, rig.names)
                _write_clouds(folder, trial, parts)
                stills = _draw(folder, run, rig, parts)
                if followed is not None:
                    stills += write_tracks(folder, followed, trial.take, rig)
                if refined is not None:
                    write_cameras_toml(rig, folder / CORRECTED_CAMERAS)
                written.result()
            report = SurfaceReport(
                title=trial.folder.resolve().name, parts=parts, first=trial.take.first, rate=trial.take.rate, rig=rig,
                refined=refined, followed=followed, stills=stills, timings=progress.timings,
                notes=[*progress.warnings, *([] if followed is None else rejection_notes(followed))],
                settings=effective | _on_page(rig, run), head=page_head("surface", verdict),
            )  # fmt: skip
            write_surface_report(folder / "surface.html", report)
        write_record(
            folder, command="surface", settings=effective, inputs=trial.input_files, root=trial.folder,
            progress=progress, verdict=verdict,
        )  # fmt: skip
    if refined is not None:
        progress.report(correction_text(rig, refined))
    progress.report(summary(parts))
    if followed is not None:
        progress.report(tracks_text(followed))


def _named(rig: Rig, template: int, searched: Sequence[int]) -> dict[str, object]:
    return {"template": rig.names[template], "searched": [rig.names[i] for i in searched]}


def _on_page(rig: Rig, run: Measurement) -> dict[str, object]:
    """Return the settings that the page shows in words; it has a table of the corrections of the cameras."""
    compared = [
        f"{rig.names[template]} matched with {listed(rig.names[i] for i in searched)}"
        for template, searched in run.compared
    ]
    return {"compared": "; ".join(compared), "rig_correction": None}


def _write_clouds(folder: Path, trial: Trial, parts: Sequence[MeasuredPoints]) -> None:
    """Write one point cloud per frame; the first one with points is also `surface.ply`."""
    first = True
    for number, part in enumerate(parts):
        if first and len(part):
            write_ply(folder / "surface.ply", part)
            first = False
        if len(parts) > 1:
            write_ply(folder / "surface" / f"frame_{trial.take.first + number:05d}.ply", part)


def _draw(folder: Path, run: Measurement, rig: Rig, parts: Sequence[MeasuredPoints]) -> list[Still]:
    """Draw the frame with the most points, and return the images for the report."""
    best = max(range(len(parts)), key=lambda number: len(parts[number]))
    points, images = parts[best], run.trial.take.images(run.trial.take.first + best)
    stills = []
    for template, _ in run.compared:
        camera = rig.cameras[template]
        depth, lit = depth_picture(points, camera, template, images[template]), lit_picture(points, camera, template)
        write_picture(folder / f"surface_{camera.name}.png", np.hstack([depth, lit]))
        where = f"{camera.name}, frame {run.trial.take.first + best}"
        stills.append(Still(caption=f"{where}: depth of the points, near ones red", image=depth))
        stills.append(Still(caption=f"{where}: the surface, lit from the side", image=lit))
    return stills


def correction(rig: Rig, refined: RigRefinement) -> Mapping[str, object]:
    """Return the correction of the cameras for the record."""
    cameras = {
        name: {"turned_deg": float(np.degrees(rotation)), "moved_mm": float(1e3 * shift), "moved_px": float(px)}
        for name, rotation, shift, px in zip(rig.names, refined.rotation, refined.shift, refined.moved_px, strict=True)
    }
    return {
        "median_residual_px": {"as_calibrated": refined.residual_before, "corrected": refined.residual_after},
        "matches": refined.tuples,
        "cameras": cameras,
    }


def correction_text(rig: Rig, refined: RigRefinement) -> str:
    """Describe the correction of the cameras."""
    each = ", ".join(
        f"{name} by {np.degrees(rotation):.3f} degrees and {1e3 * shift:.2f} mm ({px:.2f} px)"
        for name, rotation, shift, px in zip(rig.names, refined.rotation, refined.shift, refined.moved_px, strict=True)
        if shift > 0
    )
    return (
        f"The cameras were corrected by {refined.tuples} matches: {each}. The median residual of corresponding rays "
        f"fell from {refined.residual_before:.2f} to {refined.residual_after:.2f} px. See {CORRECTED_CAMERAS} in the "
        "results."
    )


def summary(parts: Sequence[MeasuredPoints]) -> str:
    """Describe the measured points in one line."""
    counts = np.array([len(part) for part in parts])
    filled = [part for part in parts if len(part)]
    residual = np.median([np.median(part.residual_px) for part in filled])
    sd = 1e3 * np.median(
        [np.median(np.sqrt(np.trace(part.covariance, axis1=1, axis2=2))) for part in filled]
    )  # fmt: skip
    several = np.mean([np.mean(part.views > 2) for part in filled])
    where = f" in {len(filled)} of {len(parts)} frames" if len(parts) > 1 else ""
    return (
        f"{counts.sum()} points{where}, {100 * several:.0f} % of them in three cameras or more; residual "
        f"{residual:.2f} px, standard deviation {sd:.2f} mm (medians)."
    )
