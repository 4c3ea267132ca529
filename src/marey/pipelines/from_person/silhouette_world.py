"""The world of cameras in any axes and unit, from the silhouettes of a person and nothing else.

The visual hulls give a first world, in which the person is captured; the captured body gives the world.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from marey.arrays import Floats, Mask
from marey.body.articulation.pose import PosedBody
from marey.body.articulation.surface import Body
from marey.body.people.person import before_images, measured_stature, person_body
from marey.body.people.person import stature as stature_of
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.fit.cameras.hull_world import hull_world
from marey.fit.cameras.person_world import PersonWorld, scale_covariance, scaled_camera
from marey.geometry.rigid import RigidTransform
from marey.images.silhouettes.background import shrunk
from marey.images.silhouettes.silhouettes import segment
from marey.io.calibration.covariance import COVARIANCE_FILE
from marey.io.trial.trial import Trial, read_trial
from marey.pipelines.calibrate.verdict import calibration_verdict
from marey.pipelines.capture.capture import follow_person, with_agreeing_cameras
from marey.pipelines.capture.run import Bodies, Logs, Run
from marey.pipelines.capture.settings import CaptureSettings
from marey.pipelines.from_person.given_cameras import require_other_folder, world_findings, world_lines, write_world
from marey.pipelines.from_person.planted_world import CapturedPerson3d, PlantedWorld, planted_world
from marey.pipelines.from_person.refined_cameras import CAMERAS_FILE, PersonCalibration, recorded_settings
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.silhouettes.empty_rooms import model_backgrounds, resized
from marey.pipelines.silhouettes.small_take import spread
from marey.pipelines.values import issue_warnings

HULL_FRAMES = 40
"""Number of frames whose silhouettes give the first world. Chosen by hand."""
STANDING_SHARE_OF_STATURE = 0.93
"""Height of a person's visual hull relative to the stature. It was 0.91 to 0.99 in three rendered takes, and less in
the creeping one; some centimetres too much or too little do not matter to the capture."""
BODY_SD = 0.015
"""Standard deviation of the stature of a captured body, relative: those of rendered takes are up to 1.2 % off."""
_ADVICE = "Film a person who walks or stands upright, with images of the empty room in background/."
"""What to film if silhouettes do not give the world."""


def calibrate_person_world(
    trial: Path | str, *, out: Path | str, cameras: tuple[str, ...] | None = None,
    frames: tuple[int, int] | None = None, keypoints: Path | str | None = None, stature: float | None = None,
    keep_scale: bool = False, progress: Progress | None = None,
) -> PersonCalibration:  # fmt: skip
    """Find origin, axes and scale of the cameras of a trial, as `marey calibrate --from-person --world-only` does.

    Lenses and relative poses are kept. The person is captured by the silhouettes. Feet that stand still lie on the
    floor; they, the balance of the person, and the trunk determine up. The way of a walk, or the hips of a standing
    person, set the heading, and the stature the scale.

    Args:
        trial: The folder of the trial, whose cameras may have any axes and unit.
        out: Folder for `cameras.toml` and `calibration.json`.
        cameras: Names of the cameras to use.
        frames: First frame and the one after the last.
        keypoints: A folder with the joints that a detector found in every image; they only help to find the person.
        stature: The person's height [m]; without, the mean person sets the scale.
        keep_scale: Whether the unit of the cameras is the metre, so that the scale is kept.
        progress: Progress reporter; by default nothing is shown, and warnings are issued as Python warnings.

    Returns:
        The cameras, with the covariance that the scale gives.

    Raises:
        FileProblem: Something in the trial cannot be used, or the results would overwrite its cameras.
        NotUsable: The cameras contradict each other.
    """
    reporter, out = RecordingProgress() if progress is None else progress, Path(out)
    settings = CaptureSettings(
        out=out, cameras=cameras, frames=frames, keypoints=None if keypoints is None else Path(keypoints),
        stature_m=stature, overlay=False,
    )  # fmt: skip
    opened = read_trial(trial, **settings.changes())
    require_other_folder(out, Path(trial), opened.calibration)
    known = opened.settings.stature_m
    rough, motion, unit = _first_world(opened, known, keep_scale=keep_scale, progress=reporter)
    found: list[PersonCalibration] = []

    def work(run: Run, bodies: Bodies, logs: Logs) -> None:
        found.append(_found(run, bodies, logs, (motion, unit), known, keep_scale=keep_scale))

    with_agreeing_cameras(rough, settings, reporter, work, results=(CAMERAS_FILE, COVARIANCE_FILE))
    if progress is None:
        issue_warnings(reporter)
    return found[-1]


def _first_world(
    opened: Trial, stature: float | None, *, keep_scale: bool, progress: Progress
) -> tuple[Trial, RigidTransform, float]:
    """Return the trial in the world of the visual hulls, the motion to it, and metres per unit of the cameras."""
    given = opened.masks or opened.evidence
    wanting = [name for name in opened.rig.names if name not in opened.background and name not in given]
    if wanting:
        wrong = f"has no image of the empty room, and no silhouettes, of {', '.join(wanting)}"
        raise FileProblem(opened.folder, wrong, f"{_ADVICE} Or give detected joints (--from-keypoints).")
    small, pictures = _silhouettes(opened, progress)
    with progress.stage("Visual hulls"):
        first = hull_world(small, pictures)
    if first is None:
        raise FileProblem(opened.folder, "shows no upright person whose silhouettes agree", _ADVICE)
    expected = stature_of(person_body("coarse"))[0] if stature is None else stature
    unit = 1.0 if keep_scale else STANDING_SHARE_OF_STATURE * expected / first.height
    rig = Rig(tuple(scaled_camera(camera.moved(first.world_from_given), unit) for camera in opened.rig))
    settings = opened.settings.model_copy(update={"stature_m": None})
    rough = replace(opened, rig=rig, settings=settings, camera_covariance=None, up_given=False)
    return rough, first.world_from_given, unit


def _silhouettes(trial: Trial, progress: Progress) -> tuple[Sequence[Camera], list[list[Mask]]]:
    """Return cameras, and their silhouettes in some frames."""
    frames, given = spread(range(trial.take.first, trial.take.end), HULL_FRAMES), trial.masks or trial.evidence
    if all(name in given for name in trial.rig.names):
        each = [list(given[name].masks(frames)) for name in trial.rig.names]
        return trial.rig.cameras, [list(masks) for masks in zip(*each, strict=True)]
    models, small = model_backgrounds(trial, progress)
    sized = [shrunk(model, camera.size) for model, camera in zip(models, small, strict=True)]
    pictures = []
    with progress.stage("Silhouettes", len(frames)) as step:
        for _, images in trial.take.at(frames):
            pictures.append([segment(resized(image, c), model).mask for image, c, model in zip(
                images, small, sized, strict=True)])  # fmt: skip
            step()
    return small, pictures


def _found(
    run: Run, bodies: Bodies, logs: Logs, first: tuple[RigidTransform, float], stature: float | None, *,
    keep_scale: bool,
) -> PersonCalibration:  # fmt: skip
    """Capture the person, and find and write the world."""
    followed = follow_person(run, bodies, logs)
    poses = {frame: pose for frame, pose in followed.tracked.poses.items() if frame not in followed.filled}
    body = followed.tracked.body
    planted = planted_world(captured_person(body, [PosedBody(body, pose) for pose in poses.values()], np.array(
        [frame / run.trial.take.rate for frame in poses])))  # fmt: skip
    if planted is None:
        raise FileProblem(run.trial.folder, "shows no feet that stand on the floor", _ADVICE)
    factor, sd = (1.0, 0.0) if keep_scale else _scale(body, stature)
    world = _person_world(followed.rig or run.trial.rig, planted, factor, sd, unit=first[1])
    contradictions = world_findings(world)
    for each in contradictions:
        run.progress.warn(f"{each['text']} {each['advice']}")
    # Repairs were reported when they were made.
    findings = [*contradictions, *_repaired(run)]
    lines = world_lines(world, keep_scale=keep_scale)
    about = recorded_settings(
        from_person=True, keep_scale=keep_scale,
        **run.trial.settings.model_copy(update={"stature_m": stature}).model_dump(mode="json", exclude_none=True),
    )  # fmt: skip
    write_world(run.out, world, lines, findings, run.trial.folder, run.progress, about)
    return PersonCalibration(
        path=run.out / CAMERAS_FILE, cameras=Rig(world.cameras), covariance=world.covariance, undetermined=(),
        lines=lines, verdict=calibration_verdict(findings),
    )  # fmt: skip


def _repaired(run: Run) -> list[dict[str, str]]:
    """Return what was repaired of cameras that contradicted the silhouettes, as findings."""
    return [
        {"code": "cameras-repaired", "severity": "caution", "text": each.what, "advice": each.remedy or ""}
        for each in run.repairs.reasons
    ]


def _person_world(rig: Rig, planted: PlantedWorld, factor: float, sd: float, *, unit: float) -> PersonWorld:
    cameras = tuple(scaled_camera(camera.moved(planted.world_from_capture), factor) for camera in rig)
    return PersonWorld(
        cameras=cameras, covariance=scale_covariance(cameras, sd), scale=factor * unit, scale_sd=sd,
        up_sd=planted.up_sd, floor_sd=factor * planted.floor_sd, heading_sd=planted.heading_sd, walked=planted.walked,
        backwards=planted.backwards, residual_rad=0.0,
    )  # fmt: skip


def _scale(body: Body, stature: float | None) -> tuple[float, float]:
    """Return metres per unit of the capture, and its relative standard deviation."""
    height, _ = measured_stature(body) or stature_of(body)
    if stature is not None:
        return stature / height, BODY_SD
    mean, sd = stature_of(before_images(person_body("coarse")))
    return mean / height, float(np.hypot(BODY_SD, sd / mean))


def captured_person(body: Body, posed: Sequence[PosedBody], time: Floats) -> CapturedPerson3d:
    """Return the points of a captured person from which the world is found.

    Args:
        body: The body.
        posed: The body in K frames.
        time: (K,) their times [s].
    """
    at = {name: np.array([each.segment_origin[k] for each in posed])
          for k, name in enumerate(body.skeleton.segment_names)}  # fmt: skip

    def middle(segment: str) -> Floats:
        return np.asarray(0.5 * (at[f"left_{segment}"] + at[f"right_{segment}"]))

    parts = sole_vertices(body)
    return CapturedPerson3d(
        time=time, soles=np.array([[each.vertices[part].mean(axis=0) for part in parts] for each in posed]),
        mass=np.array([_centroid(each.vertices[body.faces]) for each in posed]),
        trunk=middle("upperarm") - middle("foot"), hips=middle("thigh"), right=at["right_thigh"] - at["left_thigh"],
    )  # fmt: skip


SOLE_M = 0.012
"""Height above the lowest point of a foot at rest up to which vertices belong to the sole [m]. Chosen by hand."""
SOLE_PARTS = ((0.0, 0.3), (0.6, 0.85), (0.85, 1.0))
"""Ranges of heel, ball and toes, as shares of the length of the foot from the heel. Chosen by hand."""


def sole_vertices(body: Body) -> list[Mask]:
    """Return the vertices (V,) of the undersides of heel, ball and toes of the left foot, then of the right one."""
    rest, names = body.vertices, body.skeleton.segment_names
    own = body.vertex_segments[np.arange(len(rest)), np.argmax(body.vertex_weights, axis=1)]
    found = []
    for side in ("left", "right"):
        foot = np.isin(own, [names.index(f"{side}_foot"), names.index(f"{side}_toes")])
        sole = foot & (rest[:, 2] < rest[foot, 2].min() + SOLE_M)
        # A person at rest looks along -Y.
        share = (rest[foot, 1].max() - rest[:, 1]) / np.ptp(rest[foot, 1])
        found += [sole & (share >= low) & (share <= high) for low, high in SOLE_PARTS]
    return found


def _centroid(corners: Floats) -> Floats:
    """Return the centroid (3,) of the space within closed triangles (T, 3, 3)."""
    a, b, c = corners.transpose(1, 0, 2)
    volume = np.einsum("ti,ti->t", a, np.cross(b, c))
    return np.asarray(volume @ (a + b + c) / (4.0 * volume.sum()))
