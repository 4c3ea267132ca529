"""A calibration in one call, from a folder of videos or pictures of a board."""

import json
from collections.abc import Mapping
from pathlib import Path

from marey.io.calibration.readers import write_cameras_toml
from marey.pipelines.calibrate.content import calibration_content, world_text
from marey.pipelines.calibrate.result import CAMERAS_FILE, DATA_FILE, REPORT_FILE, Calibration
from marey.pipelines.calibrate.run import CalibratedSession, calibrated_session
from marey.pipelines.calibrate.settings import CalibrationOptions, given_lens_models
from marey.pipelines.calibrate.verdict import calibration_verdict
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.result_files import ResultFiles
from marey.pipelines.run_details import page_head
from marey.pipelines.run_record import finished_together, write_record
from marey.pipelines.values import issue_warnings
from marey.process import usable_cores
from marey.view.pages.calibration_report import CalibrationReport, write_calibration_report


def calibrate(
    folder: Path | str,
    *,
    out: Path | str | None = None,
    board: Path | str | None = None,
    points: Path | str | None = None,
    floor: str = "auto",
    rate: float | None = None,
    distances: Mapping[tuple[str, str], float] | None = None,
    lens: str | Mapping[str, str] | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate cameras from videos or pictures of a board or wand, as the command `marey calibrate` does.

    All cameras, lenses and poses are adjusted together, and the covariance of every parameter is stated.

    Args:
        folder: Folder with a video or numbered pictures of each camera, and `board.json` or `board.toml`.
        out: Folder for the results. By default they are in a temporary folder until `Calibration.save` is called.
        board: Description of the board, if it is elsewhere.
        points: File of points with known coordinates, which set the world: tags, named points or static markers.
        floor: Pictures in which the board lies on the floor and sets the world: `auto` searches them, `first`, `last`,
            a number, a range `A:B` without its end, or `none`.
        rate: Pictures per second that are used of each video; by default all up to 15, else about 10.
        distances: Known distances between cameras by pairs of names, which check the scale [m].
        lens: Distortion coefficients of all lenses, such as `k1,k2` or `none`, or by name of the camera; by default the
            corners decide.
        progress: Progress reporter; by default nothing is shown, and the warnings of the run are issued as Python
            warnings of the category `marey.MareyWarning`.

    Returns:
        The cameras, with covariances and findings.

    Raises:
        FileProblem: The folder, one of its files or the board cannot be used.
        SettingProblem: A setting cannot be used.

    Example:
        >>> import marey
        >>> calibration = marey.calibrate("session", floor="last")  # doctest: +SKIP
        >>> calibration.usable  # doctest: +SKIP
        True
    """
    files = ResultFiles.at(out)
    options = CalibrationOptions(
        out=files.folder, board=None if board is None else Path(board), floor=floor, rate=rate,
        points=None if points is None else Path(points),
        distances=tuple((*pair, metres) for pair, metres in (distances or {}).items()),
        lenses=given_lens_models(lens), threads=usable_cores(),
    )  # fmt: skip
    reporter = RecordingProgress() if progress is None else progress
    written = (CAMERAS_FILE, DATA_FILE, REPORT_FILE)
    with calibrated_session(Path(folder), options, reporter, results=written) as found:
        for each in found.findings:
            if each.severity == "problem":
                reporter.warn(f"{each.text} {each.advice}")
        _write(found, options, reporter)
    if progress is None:
        issue_warnings(reporter)
    return Calibration(files)


def _write(found: CalibratedSession, options: CalibrationOptions, progress: Progress) -> None:
    """Write all results at once."""
    solved, corners = found.solved, found.corners
    points = [found.points_path] if found.points_path else []
    settings: dict[str, object] = {
        "board": found.board_path.name, "points": points[0].name if points else None,
        "floor": options.floor, "rate": options.rate,
        "distances": [f"{a} {b} {metres:g} m" for a, b, metres in options.distances] or None,
        "lens": [" ".join((name or "all", *(model or ("none",)))) for name, model in options.lenses] or None,
    }  # fmt: skip
    content = calibration_content(found)
    verdict = calibration_verdict(content["findings"])
    seen = [camera for camera, each in enumerate(found.cameras) if each.corners]
    names, sizes = [corners.cameras[k] for k in seen], [corners.sizes[k] for k in seen]
    rig = solved.state.of_cameras(seen).rig(names, sizes)
    connected = found.together and len({int(solved.joined[k]) for k in seen}) == 1
    inputs = [found.board_path, *points, *(path for each in found.session.clips for path in each.clip.paths)]
    with finished_together(options.out, inputs=inputs) as folder:
        write_cameras_toml(rig, folder / CAMERAS_FILE, poses_known=connected)
        (folder / DATA_FILE).write_text(json.dumps(content, separators=(",", ":")) + "\n", encoding="utf-8")
        report = CalibrationReport(
            title=found.session.folder.resolve().name, state=solved.state, corners=solved.corners,
            residual=solved.adjusted.residual, board=found.board, cameras=found.cameras, volume=found.volume,
            views=found.views, findings=found.findings, left_out=solved.left_out, world=world_text(found),
            together=found.together, timings=progress.timings, settings=settings,
            head=page_head("calibrate", verdict), choices=solved.choices, delays=found.delays, clock=found.clock,
        )  # fmt: skip
        write_calibration_report(folder / REPORT_FILE, report)
        write_record(
            folder, command="calibrate", settings=settings, inputs=inputs, root=found.session.folder, progress=progress,
            verdict=verdict,
        )  # fmt: skip
