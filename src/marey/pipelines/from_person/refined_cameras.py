"""Cameras of a trial refined by its person: silhouettes and body, in the least squares of a capture."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.cameras.parameters import PARAMETER_NAMES, PARAMETERS
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.fit.cameras.refine import CAMERA_ROUNDS, CameraPrior, RefinedCameras, refine_cameras
from marey.io.calibration.covariance import COVARIANCE_FILE
from marey.io.calibration.readers import write_cameras_toml
from marey.io.trial.trial import Trial, read_trial
from marey.pipelines.calibrate.result import REPORT_FILE
from marey.pipelines.calibrate.verdict import calibration_verdict
from marey.pipelines.cameras.knocked import displacement, displacement_sd
from marey.pipelines.capture.capture import follow_person, with_agreeing_cameras
from marey.pipelines.capture.run import Bodies, Logs, Run
from marey.pipelines.capture.settings import CaptureSettings
from marey.pipelines.capture.tracked import frames_for_sizes
from marey.pipelines.from_person.camera_changes import camera_changes
from marey.pipelines.from_person.refined_page import RefinedPage, write_refined_page
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.run_details import page_head
from marey.pipelines.run_record import finished_together, write_record
from marey.pipelines.values import issue_warnings
from marey.pipelines.verdict import Verdict
from marey.wording import listed

DISPLACED = CameraPrior(turn_rad=0.02, shift_m=0.03)
"""Errors of the cameras of a calibration before their refinement: 1.1 degrees and 30 mm. Chosen by hand."""
CAMERAS_FILE = "cameras.toml"
"""Name of the file with the refined cameras."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PersonCalibration:
    """Cameras that were refined by the person of a trial."""

    path: Path
    """The file with the cameras; calibration.json with their covariance is beside it."""
    cameras: Rig
    covariance: Floats
    """(15 C, 15 C) of the cameras' parameters in the order of `PARAMETER_NAMES`; lenses are not estimated."""
    undetermined: tuple[str, ...]
    """Cameras that the take does not determine."""
    lines: tuple[str, ...]
    """What was found for each camera, in words, and whether to use the new cameras if there were cameras before."""
    verdict: Verdict = field(default_factory=Verdict)
    """How far the cameras can be used, and what limits it."""
    report: Path | None = None
    """The page with the changes of the cameras; None if there is none."""

    @property
    def usable(self) -> bool:
        """Whether the take determines all cameras."""
        return not self.undetermined


def calibrate_from_person(
    trial: Path | str, *, out: Path | str, cameras: tuple[str, ...] | None = None,
    frames: tuple[int, int] | None = None, keypoints: Path | str | None = None, stature: float | None = None,
    progress: Progress | None = None,
) -> PersonCalibration:  # fmt: skip
    """Refine the cameras of a trial by its person, as `marey calibrate --from-person` does.

    The person is captured, and the cameras are adjusted together with motion and body. A camera that was knocked is
    found again first. The world stays where the cameras as a whole were.

    Args:
        trial: The folder of the trial.
        out: Folder for `cameras.toml` and `calibration.json`.
        cameras: Names of the cameras to use.
        frames: First frame and the one after the last.
        keypoints: A folder with the joints that a detector found in every image; they help to find the person, and are
            not used for the cameras.
        stature: The person's height [m].
        progress: Progress reporter; by default nothing is shown, and warnings are issued as Python warnings.

    Returns:
        The cameras with their covariance.

    Raises:
        FileProblem: Something in the trial cannot be used, or the results would overwrite its cameras.
    """
    reporter, out = RecordingProgress() if progress is None else progress, Path(out)
    settings = CaptureSettings(
        out=out, cameras=cameras, frames=frames, keypoints=None if keypoints is None else Path(keypoints),
        stature_m=stature, overlay=False,
    )  # fmt: skip
    opened = read_trial(trial, **settings.changes())
    if out.resolve() == opened.calibration.parent.resolve():
        raise FileProblem(out, "is the folder of the trial's cameras", "Give another folder for the results (--out).")
    found: list[PersonCalibration] = []

    def work(run: Run, bodies: Bodies, logs: Logs) -> None:
        found.append(_refined(run, bodies, logs, opened, settings))

    with_agreeing_cameras(opened, settings, reporter, work, results=(CAMERAS_FILE, COVARIANCE_FILE, REPORT_FILE))
    if progress is None:
        issue_warnings(reporter)
    return found[-1]


def _refined(
    run: Run, bodies: Bodies, logs: Logs, opened: Trial, settings: CaptureSettings
) -> PersonCalibration:  # fmt: skip
    followed = follow_person(run, bodies, logs)
    run = replace(run, trial=replace(run.trial, rig=followed.rig or run.trial.rig))
    tracked = followed.tracked
    with run.progress.stage("Cameras and motion", CAMERA_ROUNDS) as step:
        refined = refine_cameras(
            followed.take(run), tracked.body, tracked.poses, frames_for_sizes(run, tracked.scores), run.person,
            priors=[DISPLACED] * len(run.trial.rig), height=run.person.fine_height, progress=step,
        )  # fmt: skip
    lines = _lines(opened.rig.cameras, refined)
    file_from_world = opened.world_from_file.inverse()
    rig = Rig(tuple(camera.moved(file_from_world) for camera in refined.cameras)) if opened.up_given else Rig(
        refined.cameras
    )  # fmt: skip
    before = opened.rig.cameras
    changes = None if refined.undetermined else camera_changes(before, refined.cameras, refined.covariance)
    findings = [_undetermined(refined) if changes is None else changes.finding()]
    verdict = calibration_verdict(findings)
    page = RefinedPage(
        title=run.trial.folder.resolve().name, before=before, refined=refined, changes=changes,
        head=page_head("calibrate", verdict), settings=_about(opened, settings),
        notes=[f"{each['text']} {each['advice']}" for each in findings if each["severity"] == "note"],
    )  # fmt: skip
    _write(run, rig, lines, findings, page)
    return PersonCalibration(
        path=run.out / CAMERAS_FILE, cameras=rig, covariance=refined.covariance, undetermined=refined.undetermined,
        lines=(*lines, *page.notes), verdict=verdict, report=run.out / REPORT_FILE,
    )  # fmt: skip


def _about(opened: Trial, settings: CaptureSettings) -> dict[str, object]:
    """Return the settings of the run for the record."""
    effective = opened.settings.model_dump(mode="json", exclude_none=True)
    return recorded_settings(from_person=True, **effective | recorded_settings(keypoints=settings.keypoints))


def _undetermined(refined: RefinedCameras) -> dict[str, str]:
    """Return which cameras the take does not determine, as a finding."""
    text = f"The take does not determine {listed(refined.undetermined)}."
    advice = "Film a person who walks through the whole volume and turns, seen by all cameras."
    return {"code": "undetermined", "severity": "problem", "text": text, "advice": advice}


def _lines(before: tuple[Camera, ...], refined: RefinedCameras) -> tuple[str, ...]:
    """Say for each camera by how much it was moved, and whether the take determines it."""
    lines = []
    for c, (old, new) in enumerate(zip(before, refined.cameras, strict=True)):
        own = slice(PARAMETERS * c, PARAMETERS * (c + 1))
        (turn, shift), (turn_sd, shift_sd) = displacement(old, new), displacement_sd(new, refined.covariance[own, own])
        note = "; the take does not determine it" if new.name in refined.undetermined else ""
        lines.append(
            f"{new.name}: turned by {turn:.2f} degrees (sd {turn_sd:.2f}), shifted by {shift:.0f} mm "
            f"(sd {shift_sd:.0f}){note}"
        )
    return tuple(lines)


def _write(
    run: Run, rig: Rig, lines: tuple[str, ...], findings: Sequence[dict[str, str]], page: RefinedPage
) -> None:
    """Write cameras.toml, calibration.json and the page at once."""
    for each in findings:
        if each["severity"] != "note":
            run.progress.warn(f"{each['text']} {each['advice']}")
    world = "that of the given cameras as a whole"
    content = person_content(rig, page.refined.covariance, lines, findings, source="person", world=world)
    with finished_together(run.out) as folder:
        write_cameras_toml(rig, folder / CAMERAS_FILE)
        (folder / COVARIANCE_FILE).write_text(json.dumps(content, separators=(",", ":")) + "\n", encoding="utf-8")
        timed = replace(page, timings=run.progress.timings, notes=[*page.notes, *run.progress.warnings])
        write_refined_page(folder / REPORT_FILE, timed)
        write_record(
            folder, command="calibrate", settings=page.settings, inputs=run.trial.input_files, root=run.trial.folder,
            progress=run.progress, verdict=calibration_verdict(findings),
        )  # fmt: skip


def recorded_settings(**given: object) -> dict[str, object]:
    """Return the settings that were given, for the record; paths as texts.

    Args:
        given: Settings by name; None and false for those that were not given.
    """
    known = {name: value for name, value in given.items() if value is not None and value is not False}
    return {name: str(value) if isinstance(value, Path) else value for name, value in known.items()}


def person_content(
    rig: Rig, covariance: Floats, lines: Sequence[str], findings: Sequence[dict[str, str]], *, source: str, world: str
) -> dict[str, Any]:
    """Return what calibration.json has of cameras that were found by a person.

    Args:
        rig: C cameras.
        covariance: (15 C, 15 C) of their parameters.
        lines: What was found for each camera, in words.
        findings: Problems with `code`, `severity`, `text` and `advice`.
        source: What the cameras were found by.
        world: Where the axes are, in words.
    """
    sd = np.sqrt(np.maximum(np.diag(covariance).reshape(-1, PARAMETERS)[:, 0], 0.0))
    return {
        "source": source, "together": True, "world": world,
        "cameras": {
            camera.name: {"lens": {"fx": {"value": float(camera.matrix[0, 0]), "sd": float(own)}}, "text": line}
            for camera, line, own in zip(rig, lines, sd, strict=True)
        },
        "covariance": {
            "parameters": [f"{name}.{key}" for name in rig.names for key in PARAMETER_NAMES],
            "units": "px, 1, rad and m; rotations turn the camera's axes on the left, translations as in cameras.toml",
            "matrix": np.asarray(covariance).tolist(),
        },
        "findings": list(findings),
    }  # fmt: skip
