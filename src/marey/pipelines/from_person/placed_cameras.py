"""Cameras of a trial found from detected joints and approximate focal lengths alone, then refined by silhouettes."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from marey.arrays import Floats, Mask
from marey.body.people.person import person_body
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.errors import FileProblem, SettingProblem
from marey.fit.cameras.from_joints import BoneLengths, PlacedCameras, block_basis, place_cameras
from marey.fit.cameras.from_silhouettes import refine_by_tangents
from marey.fit.cameras.frontier import SilhouetteHulls
from marey.fit.cameras.joint_pairs import BONES, JointSightings
from marey.geometry.rigid import RigidTransform
from marey.images.silhouettes.background import Background, shrunk
from marey.io.calibration.covariance import COVARIANCE_FILE
from marey.io.calibration.readers import read_rig, write_cameras_toml
from marey.io.run_files import require_own_folder
from marey.io.trial.clocks import CLOCKS_FILE
from marey.io.trial.key_points import files_of_camera, read_key_points
from marey.io.trial.layout import find_layout
from marey.io.trial.trial import Trial, read_free_trial
from marey.io.video.clip_files import videos_in
from marey.io.video.video import Clip, open_video
from marey.pipelines.calibrate.verdict import calibration_verdict
from marey.pipelines.cameras.knocked import displacement_sd
from marey.pipelines.from_person.refined_cameras import (
    CAMERAS_FILE,
    PersonCalibration,
    person_content,
    recorded_settings,
)
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.run_record import finished_together, write_record
from marey.pipelines.silhouettes.empty_rooms import model_backgrounds, resized
from marey.pipelines.silhouettes.stages import SilhouetteState, update_silhouette
from marey.pipelines.values import issue_warnings
from marey.wording import listed

DETECTED_BONE_SD_M = 0.03
"""Standard deviation of the difference of a bone's length between a detector's joints and the body's [m]: a detector's
joints are 23 to 56 mm from the true centres (`marey.fit.recipes.detections`), partly in the same direction."""
WORLD = "Z up along the person, the floor at 0; the scale is that of the person's bones"
"""Where the axes of the cameras are, in words."""
_DIFFERENCE = 1e-4
"""Step of the numerical derivatives by a number of the body."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Found:
    """Cameras, their covariance, and in words how good they are."""

    cameras: tuple[Camera, ...]
    covariance: Floats
    note: str


def calibrate_from_keypoints(
    trial: Path | str, keypoints: Path | str, *, out: Path | str, focal: Mapping[str, float] | float | None = None,
    cameras: tuple[str, ...] | None = None, frames: tuple[int, int] | None = None, stature: float | None = None,
    progress: Progress | None = None,
) -> PersonCalibration:  # fmt: skip
    """Find the cameras of a trial from detected joints, as `marey calibrate --from-keypoints` does.

    If the trial has images of the empty room, or silhouettes, of all cameras, these refine the cameras.

    Args:
        trial: The folder with the videos.
        keypoints: A folder with the joints that a detector found in every image.
        out: Folder for `cameras.toml` and `calibration.json`.
        focal: Approximate focal lengths [px], one for all or by camera; without, the lenses are those of the trial's
            calibration, whose poses are ignored.
        cameras: Names of the cameras to use.
        frames: First frame and the one after the last.
        stature: The person's height [m], which sets the scale; without, that of the mean person does.
        progress: Progress reporter; by default nothing is shown, and warnings are issued as Python warnings.

    Returns:
        The cameras with their covariance. Nothing is written if some of them share too few joints with the others.

    Raises:
        FileProblem: Something in the trial cannot be used, or the results would overwrite its cameras.
        SettingProblem: A focal length is missing or impossible.
    """
    reporter, out, folder = RecordingProgress() if progress is None else progress, Path(out), Path(trial)
    lenses, sources = _lenses(folder, focal, cameras)
    if (folder / CLOCKS_FILE).is_file():
        reporter.warn("sync.json is not used: pictures of one number count as pictures of one instant.")
    if out.resolve() in {path.parent.resolve() for path in sources}:
        raise FileProblem(out, "is the folder of the trial", "Give another folder for the results (--out).")
    require_own_folder(out, [folder])
    seen = read_sightings(Path(keypoints), Rig(lenses), frames)
    with reporter.stage("Cameras from joints"):
        placed = place_cameras(lenses, seen, bone_lengths(stature))
    found = _Found(cameras=placed.cameras, covariance=placed.covariance, note="")
    if placed.undetermined:
        for each in _findings(placed.undetermined):
            reporter.warn(f"{each['text']} {each['advice']}")
    else:
        found = _by_silhouettes(folder, found, reporter)
        reporter.report(_summary(placed, found))
    lines = () if np.isnan(found.covariance).any() else _lines(found)
    findings = _findings(placed.undetermined)
    if lines:
        about = recorded_settings(
            keypoints=Path(keypoints), focal=focal, cameras=cameras, frames=frames, stature=stature
        )
        _write(out, found, lines, findings, sources, folder, reporter, about)
    if progress is None:
        issue_warnings(reporter)
    return PersonCalibration(
        path=out / CAMERAS_FILE, cameras=Rig(found.cameras), covariance=found.covariance,
        undetermined=placed.undetermined, lines=lines, verdict=calibration_verdict(findings),
    )  # fmt: skip


SHORTEST_M, TALLEST_M = 0.3, 2.8
"""Heights of people lie between these [m], as in trial.toml."""
_ADVICE = "Film a person who walks through the whole volume and turns, seen by all cameras at once."
"""What to film if a take does not determine its cameras."""


def bone_lengths(stature: float | None = None) -> BoneLengths:
    """Return the lengths of the bones of people, with the covariance of their logarithms.

    Args:
        stature: The person's height [m], if it is known.

    Raises:
        SettingProblem: It is not the height of a person.
    """
    if stature is not None and not SHORTEST_M < stature < TALLEST_M:
        wanted = f"it should be more than {SHORTEST_M} and less than {TALLEST_M} m"
        raise SettingProblem(f"stature (--stature) is {stature:g}; {wanted}.")
    body = person_body("fine", stature_m=stature)
    names, space = list(body.joint_names), body.space

    def lengths(numbers: Floats) -> Floats:
        joints = space.joints(numbers)[body.joint_segments]
        return np.array([np.linalg.norm(joints[names.index(a)] - joints[names.index(b)]) for a, b in BONES])

    mean = np.asarray(space.prior_mean)
    expected = lengths(mean)
    steps = _DIFFERENCE * np.eye(len(mean))
    slopes = np.array([(lengths(mean + step) - lengths(mean - step)) / (2 * _DIFFERENCE) for step in steps]).T
    slopes = slopes / expected[:, None]
    detected = np.diag((DETECTED_BONE_SD_M / expected) ** 2)
    return BoneLengths(expected_m=expected, covariance=slopes @ space.prior_covariance @ slopes.T + detected)


def _lenses(
    folder: Path, focal: Mapping[str, float] | float | None, names: Sequence[str] | None
) -> tuple[tuple[Camera, ...], list[Path]]:
    """Return the cameras of a trial with approximate lenses and without poses, and the files that state them."""
    if focal is None:
        source = find_layout(folder).calibration
        rig = read_rig(source)
        rig = rig if names is None else rig.subset(names)
        return tuple(replace(camera, camera_from_world=RigidTransform.identity()) for camera in rig), [
            source if source.is_file() else source / CAMERAS_FILE
        ]
    videos = {path.stem: path for path in videos_in(folder)}
    if len(videos) < 2:
        raise FileProblem(folder, f"has {len(videos)} videos", "Depth needs at least two cameras.")
    chosen = list(videos) if names is None else list(names)
    given = focal if isinstance(focal, Mapping) else dict.fromkeys(chosen, float(focal))
    unknown = [name for name in {**given, **dict.fromkeys(chosen)} if name not in videos]
    missing = [name for name in chosen if name not in given]
    if unknown or missing:
        what = f"no video of {listed(unknown)}" if unknown else f"no focal length of {listed(missing)}"
        raise SettingProblem(f"--focal: there is {what}; the videos are {', '.join(videos)}.")
    return tuple(_pinhole(name, open_video(videos[name]).size, given[name]) for name in chosen), list(videos.values())


def _pinhole(name: str, size: tuple[int, int], focal: float) -> Camera:
    matrix = np.array([[focal, 0.0, (size[0] - 1) / 2], [0.0, focal, (size[1] - 1) / 2], [0.0, 0.0, 1.0]])
    return Camera(
        name=name, size=size, matrix=matrix, distortion=np.zeros(0), camera_from_world=RigidTransform.identity()
    )


def read_sightings(folder: Path, rig: Rig, frames: tuple[int, int] | None) -> JointSightings:
    """Read the joints of the most confident person in each image.

    Args:
        folder: The folder with the joints.
        rig: The cameras.
        frames: First frame and the one after the last; None for all.

    Raises:
        FileProblem: The folder cannot be used.
    """
    count = max((max(files_of_camera(folder, name), default=-1) + 1 for name in rig.names), default=0)
    points = read_key_points(folder, rig, count=max(count, 1))
    used = slice(*(frames or (0, count)))
    return JointSightings(
        joint_names=points.joint_names, pixels=points.pixels[used, :, 0], confidence=points.confidence[used, :, 0]
    )


def _by_silhouettes(folder: Path, found: _Found, progress: Progress) -> _Found:
    """Refine cameras by the silhouettes of a trial that shows its empty room, or has silhouettes."""
    with TemporaryDirectory() as place:
        path = Path(place) / CAMERAS_FILE
        write_cameras_toml(Rig(found.cameras), path)
        names = [camera.name for camera in found.cameras]
        try:
            opened = read_free_trial(folder, calibration=str(path), cameras=names)
        except FileProblem as problem:
            progress.warn(f"The cameras are not refined by silhouettes: {problem}")
            return found
        given = opened.masks or opened.evidence
        if not all(name in opened.background or name in given for name in names):
            return found
        small, hulls = _hulls(opened, found.cameras, progress)
    covariance = _converted(found.cameras, small, found.covariance)
    with progress.stage("Cameras and silhouettes"):
        refined = refine_by_tangents(small, covariance, hulls)
    cameras = tuple(
        replace(
            camera, camera_from_world=after.camera_from_world,
            matrix=_focused(camera.matrix, after.matrix[0, 0] / before.matrix[0, 0]),
        )
        for camera, before, after in zip(found.cameras, small, refined.cameras, strict=True)
    )  # fmt: skip
    note = f"; tangents of the silhouettes {refined.before_px:.1f} px before, {refined.after_px:.1f} px after"
    return _Found(cameras=cameras, covariance=_converted(refined.cameras, cameras, refined.covariance), note=note)


def _focused(matrix: Floats, factor: float) -> Floats:
    """Return a camera matrix whose focal lengths are multiplied by a factor."""
    changed = np.array(matrix)
    changed[0, 0], changed[1, 1] = factor * matrix[0, 0], factor * matrix[1, 1]
    return changed


def _converted(before: Sequence[Camera], after: Sequence[Camera], covariance: Floats) -> Floats:
    """Return the covariance of the parameters of the same cameras with images of another size."""
    change = block_basis(after) @ np.linalg.pinv(block_basis(before))
    return np.asarray(change @ covariance @ change.T)


def _hulls(
    trial: Trial, cameras: Sequence[Camera], progress: Progress
) -> tuple[tuple[Camera, ...], list[SilhouetteHulls]]:
    """Return the cameras at the size of the silhouettes, and the silhouettes' hulls."""
    given = trial.masks or trial.evidence
    if all(camera.name in given for camera in cameras):
        small, masks = tuple(cameras), [given[camera.name].masks() for camera in cameras]
    else:
        models, sized = model_backgrounds(trial, progress)
        small = tuple(camera.scaled(other.width / camera.width) for camera, other in zip(cameras, sized, strict=True))
        masks = [_silhouettes(*each) for each in zip(trial.take.clips, models, small, strict=True)]
    hulls = []
    with progress.stage("Silhouettes", len(small)) as step:
        for camera, own in zip(small, masks, strict=True):
            hulls.append(SilhouetteHulls.of(camera, own))
            step()
    return small, hulls


def _silhouettes(clip: Clip, model: Background, camera: Camera) -> Iterator[Mask]:
    """Find the silhouettes in all pictures of one camera, independent of the others."""
    state = SilhouetteState(shrunk(model, camera.size))
    for image in clip.images(range(clip.count)):
        state = update_silhouette(state, resized(image, camera), None)
        yield state.mask


def _summary(placed: PlacedCameras, found: _Found) -> str:
    return (
        f"Cameras from {placed.points.shape[0]} frames of joints: median distance {placed.residual_px:.1f} px"
        f"{found.note}; "
        f"scale by the person's bones, standard deviation {100 * placed.scale_sd:.0f} %"
    )


def _lines(found: _Found) -> tuple[str, ...]:
    """Say for each camera how well it is known."""
    lines = []
    for c, camera in enumerate(found.cameras):
        own = found.covariance[15 * c : 15 * (c + 1), 15 * c : 15 * (c + 1)]
        turn, shift = displacement_sd(camera, own)
        focal, sd = float(camera.matrix[0, 0]), float(np.sqrt(max(own[0, 0], 0.0)))
        lines.append(
            f"{camera.name}: focal length {focal:.0f} px (sd {sd:.0f}), orientation sd {turn:.2f} degrees, position sd "
            f"{shift:.0f} mm"
        )
    return tuple(lines)


def _findings(undetermined: Sequence[str]) -> list[dict[str, str]]:
    text = f"The detected joints do not determine {listed(undetermined)}." if undetermined else ""
    return [{"code": "undetermined", "severity": "problem", "text": text, "advice": _ADVICE}] if text else []


def _write(
    out: Path, found: _Found, lines: Sequence[str], findings: Sequence[dict[str, str]], sources: Sequence[Path],
    root: Path, progress: Progress, about: Mapping[str, object],
) -> None:  # fmt: skip
    """Write cameras.toml and calibration.json at once."""
    rig = Rig(found.cameras)
    content = person_content(rig, found.covariance, lines, findings, source="detected joints", world=WORLD)
    with finished_together(out, inputs=[root, *sources]) as folder:
        write_cameras_toml(rig, folder / CAMERAS_FILE)
        (folder / COVARIANCE_FILE).write_text(json.dumps(content, separators=(",", ":")) + "\n", encoding="utf-8")
        write_record(
            folder, command="calibrate", settings={"from_keypoints": True, **about}, root=root, progress=progress,
            inputs=[p for p in sources if p.is_file()], verdict=calibration_verdict(findings),
        )  # fmt: skip
