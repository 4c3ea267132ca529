"""Cameras from the person, without a board: a knocked camera found again, and all cameras from detected joints.

Knocked cameras: the calibration turns one camera by 3 degrees and shifts it by 50 mm, in directions drawn with the
seed 0; the take is captured with this calibration. Errors are those of the camera in `corrected_cameras.toml`; the
other cameras keep their true places. Joints are those of the same capture, with those of the calibrated cameras
beside them.

Cameras from joints: the joints are those that a pretrained detector found; the focal lengths are 5 % too long and too
short in turn, and no pose is known. The silhouettes refine the cameras; `--from-person` then refines the poses with the
body. Errors are those after the similarity that fits the camera centres and orientations best.
"""

import argparse
from dataclasses import replace

import numpy as np

import marey
from bench.common.parts import add_parts, run_parts
from bench.common.program import capture, empty_frames, score, take, truth_of
from bench.common.sabotaged_takes import TakeCopy, turned, zoomed
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.io.calibration.readers import write_cameras_toml
from marey.pipelines.from_person.placed_cameras import calibrate_from_keypoints
from marey.pipelines.from_person.refined_cameras import calibrate_from_person

BENCH = Bench(
    measures="A knocked camera that the person shows, and cameras from detected joints, against the true cameras.",
    sources=(
        "src/marey/fit/cameras", "src/marey/fit/consistency", "src/marey/pipelines/cameras",
        "src/marey/pipelines/from_person", "src/marey/pipelines/capture",
    ),
    minutes=20,
)  # fmt: skip
KNOCKED = (
    ("walk", 0),
    ("walk", 2),
    ("walk", 3),
    ("stealth", 1),
    ("stealth", 3),
    ("jacks", 0),
    ("jacks", 1),
    ("reach", 2),
)
"""Takes and the numbers of the knocked cameras."""
TURN_DEG, SHIFT_MM = 3.0, 50.0
FROM_JOINTS = ("walk", "reach")
FOCAL_ERROR = 0.05


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_parts(parser, PARTS)


def run(run: Run) -> None:
    """Fill the tables."""
    run_parts(run, PARTS)


def knocked(run: Run) -> None:
    """Capture takes of which one camera was knocked."""
    table = run.table(
        "Knocked cameras", ("take", "camera"), Column("rotation", "deg", 3), Column("position", "mm", 1),
        Column("joints", "mm", 1), Column("95 % intervals hold", "", 3), Column("joints, calibrated", "mm", 1),
    )  # fmt: skip
    random = np.random.default_rng(0)
    for name, number in KNOCKED:
        trial, calibrated = take(run, name)
        copy = TakeCopy.of(trial, run.out / "knocked" / f"{name}{number + 1}")
        axis, direction = random.normal(size=(2, 3))
        copy.calibrate(lambda rig: with_knocked(rig, number, axis, direction))  # noqa: B023 - called at once
        result = capture(copy.folder, copy.folder / "results")
        corrected = result / "corrected_cameras.toml"
        off = (np.nan, np.nan)
        if corrected.exists():
            off = errors(marey.read_cameras(corrected).cameras[number], marey.read_cameras(trial).cameras[number])
        scores = [
            score(run, "capture.py", each, truth_of(trial), "--skip-empty", empty_frames(trial))
            for each in (result, calibrated)
        ]
        table.row(
            (name, copy.names[number]), *off, scores[0]["joint_mm"], scores[0]["covered_95"], scores[1]["joint_mm"]
        )


def with_knocked(rig: Rig, number: int, axis: Floats, direction: Floats) -> Rig:
    """Return the cameras with one turned about its centre and shifted."""
    cameras = list(rig.cameras)
    camera = turned(cameras[number], TURN_DEG, axis.tolist())
    pose = camera.camera_from_world
    shift = 1e-3 * SHIFT_MM * direction / np.linalg.norm(direction)
    moved = RigidTransform(pose.rotation, pose.translation - pose.rotation @ shift)
    cameras[number] = replace(camera, camera_from_world=moved)
    return Rig(tuple(cameras))


def errors(found: Camera, true: Camera) -> tuple[float, float]:
    """Return the angle between two orientations [deg] and the distance of two centres [mm]."""
    turn = found.camera_from_world.rotation @ true.camera_from_world.rotation.T
    return float(np.degrees(np.linalg.norm(rotations.log(turn)))), float(
        1e3 * np.linalg.norm(found.centre - true.centre)
    )


def from_joints(run: Run) -> None:
    """Find all cameras by detected joints and wrong focal lengths."""
    table = run.table(
        "Cameras from joints and focal lengths that are 5 % wrong", ("take", "after"), Column("rotation", "deg", 2),
        Column("position", "mm", 0), Column("focal length, worst", "%", 1), Column("scale", "", 3),
    )  # fmt: skip
    for name in FROM_JOINTS:
        trial = run.shared / "data" / "people" / name
        true = marey.read_cameras(trial)
        copy = TakeCopy.of(trial, run.out / "joints" / name)
        copy.calibrate(with_wrong_lenses)
        out = run.out / "joints" / f"{name}_found"
        placed = calibrate_from_keypoints(copy.folder, trial / "keypoints", out=out, progress=marey.RecordingProgress())
        table.row((name, "joints and silhouettes"), *fitted_errors(placed.cameras, true))
        write_cameras_toml(placed.cameras, copy.folder / "cameras.toml")
        out = run.out / "joints" / f"{name}_refined"
        with marey.tuned_process():
            refined = calibrate_from_person(copy.folder, out=out, progress=marey.RecordingProgress())
        table.row((name, "the body"), *fitted_errors(refined.cameras, true))


def with_wrong_lenses(rig: Rig) -> Rig:
    """Return the cameras with focal lengths that are too long and too short in turn."""
    return Rig(tuple(zoomed(camera, 1 + FOCAL_ERROR * (-1) ** n) for n, camera in enumerate(rig)))


def fitted_errors(found: Rig, true: Rig) -> tuple[float, float, float, float]:
    """Return errors after a similarity: rotation [deg], position [mm], worst focal length [%] and its scale."""
    turns = [(a.camera_from_world.rotation, b.camera_from_world.rotation) for a, b in zip(found, true, strict=True)]
    turn = rotations.nearest(np.sum([b.T @ a for a, b in turns], axis=0))
    own, wanted = found.centres - found.centres.mean(0), true.centres - true.centres.mean(0)
    scale = float((wanted * (own @ turn.T)).sum() / (own**2).sum())
    angles = [np.degrees(np.linalg.norm(rotations.log(a @ turn.T @ b.T))) for a, b in turns]
    focal = [100 * abs(a.matrix[i, i] / b.matrix[i, i] - 1) for a, b in zip(found, true, strict=True) for i in range(2)]
    position = 1e3 * np.sqrt(np.mean(((scale * own @ turn.T - wanted) ** 2).sum(1)))
    return float(np.sqrt(np.mean(np.square(angles)))), float(position), max(focal), 1 / scale


PARTS = {"knocked": knocked, "joints": from_joints}
