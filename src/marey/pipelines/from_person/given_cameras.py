"""The world of cameras that another program calibrated in any axes and unit, from a person in it."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.fit.cameras.person_world import PersonWorld, find_person_world
from marey.io.calibration.covariance import COVARIANCE_FILE
from marey.io.calibration.readers import read_rig, write_cameras_toml
from marey.io.trial.layout import find_layout
from marey.pipelines.calibrate.verdict import calibration_verdict
from marey.pipelines.from_person.placed_cameras import bone_lengths, read_sightings
from marey.pipelines.from_person.refined_cameras import (
    CAMERAS_FILE,
    PersonCalibration,
    person_content,
    recorded_settings,
)
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.run_record import finished_together, write_record
from marey.pipelines.values import issue_warnings

GIVEN_WORLD = "Z up along the person, the floor at 0, Y ahead; the scale is that of the person's bones"
"""Where the axes of the cameras are, in words."""
_CONTRADICTED = "Give the joints of one person, and check that the calibration belongs to these videos."
"""Advice if joints and cameras contradict each other."""


def calibrate_world(
    trial: Path | str, keypoints: Path | str, *, out: Path | str, cameras: tuple[str, ...] | None = None,
    frames: tuple[int, int] | None = None, stature: float | None = None, keep_scale: bool = False,
    progress: Progress | None = None,
) -> PersonCalibration:  # fmt: skip
    """Find origin, axes and scale of the cameras of a trial, as `marey calibrate --world-only` does.

    Lenses and relative poses are kept. A walk sets the heading and makes the way horizontal; a person who stands must
    stand upright.

    Args:
        trial: The folder of the trial, whose cameras may have any axes and unit.
        keypoints: A folder with the joints that a detector found in every image.
        out: Folder for `cameras.toml` and `calibration.json`.
        cameras: Names of the cameras to use.
        frames: First frame and the one after the last.
        stature: The person's height [m]; without, the mean person sets the scale.
        keep_scale: Whether the unit of the cameras is the metre, so that the scale is kept.
        progress: Progress reporter; by default nothing is shown, and warnings are issued as Python warnings.

    Returns:
        The cameras, with the covariance that the scale gives; not usable if the joints contradict the cameras.

    Raises:
        FileProblem: Something in the trial cannot be used, or the results would overwrite its cameras.
    """
    reporter, out, folder = RecordingProgress() if progress is None else progress, Path(out), Path(trial)
    source = find_layout(folder).calibration
    require_other_folder(out, folder, source)
    rig = read_rig(source)
    rig = rig if cameras is None else rig.subset(cameras)
    with reporter.stage("World from joints"):
        seen, lengths = read_sightings(Path(keypoints), rig, frames), bone_lengths(stature)
        found = find_person_world(rig.cameras, seen, lengths, keep_scale=keep_scale)
    if found is None:
        raise FileProblem(
            Path(keypoints), "has too few joints that two cameras see", "Film a person who walks or stands upright."
        )
    findings = world_findings(found)
    for each in findings:
        reporter.warn(f"{each['text']} {each['advice']}")
    lines = world_lines(found, keep_scale=keep_scale)
    about = recorded_settings(
        keypoints=Path(keypoints), cameras=cameras, frames=frames, stature=stature, keep_scale=keep_scale
    )  # fmt: skip
    write_world(out, found, lines, findings, folder, reporter, about)
    if progress is None:
        issue_warnings(reporter)
    return PersonCalibration(
        path=out / CAMERAS_FILE, cameras=Rig(found.cameras), covariance=found.covariance,
        undetermined=rig.names if found.contradicted else (), lines=lines,
        verdict=calibration_verdict(findings),
    )  # fmt: skip


def require_other_folder(out: Path, folder: Path, source: Path) -> None:
    """Check that results do not replace the cameras of a trial.

    Args:
        out: Folder of the results.
        folder: The trial.
        source: The calibration of the trial.

    Raises:
        FileProblem: They would.
    """
    if out.resolve() in {folder.resolve(), source.resolve(), source.parent.resolve()}:
        raise FileProblem(out, "is the folder of the trial's cameras", "Give another folder for the results (--out).")


def world_lines(found: PersonWorld, *, keep_scale: bool) -> tuple[str, ...]:
    """Return what was found, with standard deviations, in words.

    Args:
        found: The world.
        keep_scale: Whether the scale was kept.
    """
    scale = f"{found.scale:.4g} m per unit of the calibration (sd {100 * found.scale_sd:.1f} %)"
    how = "walk" if found.walked else "standing person"
    heading = "the way" if found.walked else "the hips"
    return (
        f"World from a {how}: {'the scale is kept' if keep_scale else scale}",
        f"Up to {np.degrees(found.up_sd):.1f} deg, the floor to {1e3 * found.floor_sd:.0f} mm, the heading by "
        f"{heading} to {np.degrees(found.heading_sd):.1f} deg (standard deviations)",
    )


def world_findings(found: PersonWorld) -> list[dict[str, str]]:
    """Return what is wrong with joints or person, as findings."""
    findings = []
    if found.contradicted:
        apart = np.degrees(found.residual_rad)
        text = f"The joints lie {apart:.1f} deg (median) from their projections: they contradict the cameras."
        findings.append({"code": "joints-contradict", "severity": "problem", "text": text, "advice": _CONTRADICTED})
    if found.backwards:
        text = "The person walks backwards, or right and left are exchanged: the images or the axes are mirrored."
        advice = "Check that the videos are not mirrored and that the calibration is right-handed."
        findings.append({"code": "walks-backwards", "severity": "caution", "text": text, "advice": advice})
    return findings


def write_world(
    out: Path, found: PersonWorld, lines: Sequence[str], findings: Sequence[dict[str, str]], root: Path,
    progress: Progress, about: Mapping[str, object],
) -> None:  # fmt: skip
    """Write cameras.toml and calibration.json at once.

    Args:
        out: Folder for the results.
        found: The world.
        lines: What was found, in words.
        findings: What is wrong.
        root: The trial.
        progress: Progress reporter.
        about: The settings of the run.
    """
    rig = Rig(found.cameras)
    each = [lines[0]] * len(found.cameras)
    content = person_content(rig, found.covariance, each, findings, source="given cameras", world=GIVEN_WORLD)
    with finished_together(out, inputs=[root]) as folder:
        write_cameras_toml(rig, folder / CAMERAS_FILE)
        (folder / COVARIANCE_FILE).write_text(json.dumps(content, separators=(",", ":")) + "\n", encoding="utf-8")
        write_record(
            folder, command="calibrate", settings={"world_only": True, **about}, inputs=[], root=root,
            progress=progress, verdict=calibration_verdict(findings),
        )  # fmt: skip
