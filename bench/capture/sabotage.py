"""Takes in which one thing is wrong: whether it is named, and how far the joints are off nevertheless.

Forty frames of each take are captured after a change of its videos or of its calibration. Each row states the verdict,
the cameras that it names, and the joints, if any were captured.
"""

import argparse
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

import marey
from bench.common.program import capture, score, truth_of
from bench.declaration import Bench
from bench.recording import Column, Run, Table
from marey.arrays import Image
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.io.calibration.readers import write_cameras_toml

BENCH = Bench(
    measures="Whether planted faults of cameras are named or repaired, and the joints that are captured with them.",
    sources=("src/marey/fit/consistency", "src/marey/pipelines/consistency", "src/marey/pipelines/verdict.py"),
    minutes=40,
)
TAKES = ("walk", "reach", "jacks")
FRAMES = range(30, 70)
EMPTY = 10
"""Number of leading empty frames of the takes."""

Pictures = Callable[[Sequence[Image]], Sequence[Image]]


def turned(camera: Camera, degrees: float, axis: Sequence[float] = (1.0, 1.0, 1.0)) -> Camera:
    """Return a camera that was knocked about its centre."""
    turn = rotations.exp(np.radians(degrees) * np.array(axis) / np.linalg.norm(axis))
    pose = camera.camera_from_world
    return replace(camera, camera_from_world=RigidTransform(turn @ pose.rotation, turn @ pose.translation))


def zoomed(camera: Camera, factor: float) -> Camera:
    """Return a camera with another focal length."""
    return replace(camera, matrix=np.array(camera.matrix) * [[factor, factor, 1], [1, factor, 1], [1, 1, 1]])


def with_camera(rig: Rig, number: int, camera: Camera) -> Rig:
    """Replace one camera."""
    return Rig(tuple(camera if c == number else own for c, own in enumerate(rig)))


CALIBRATIONS: dict[str, Callable[[Rig], Rig]] = {
    "calibrations 1, 2 exchanged": lambda rig: Rig(
        tuple(replace(rig.cameras[k], name=rig.names[c]) for c, k in enumerate((1, 0, 2, 3)))
    ),
    "camera 2 turned by 3 deg": lambda rig: with_camera(rig, 1, turned(rig.cameras[1], 3.0)),
    "cameras 2, 3 turned by 3 deg": lambda rig: with_camera(
        with_camera(rig, 1, turned(rig.cameras[1], 3.0)), 2, turned(rig.cameras[2], 3.0, (0.0, 1.0, 0.0))
    ),
    "focal length of 2 20 % off": lambda rig: with_camera(rig, 1, zoomed(rig.cameras[1], 1.2)),
    "calibrations 1, 2 equal": lambda rig: with_camera(rig, 1, replace(rig.cameras[0], name=rig.names[1])),
    "four equal calibrations": lambda rig: Rig(tuple(replace(rig.cameras[0], name=name) for name in rig.names)),
}
"""Changes of the calibration."""
VIDEOS: dict[str, Pictures] = {
    "pictures of 3 mirrored": lambda images: [np.ascontiguousarray(image[:, ::-1]) for image in images],
    "pictures of 3 turned by 180 deg": lambda images: [np.ascontiguousarray(image[::-1, ::-1]) for image in images],
    "camera 3 late by 3 frames": lambda images: [*images[:1] * 3, *images[:-3]],
    "camera 3 late by 10 frames": lambda images: [*images[:1] * 10, *images[:-10]],
    "camera 3 late by 15 frames": lambda images: [*images[:1] * 15, *images[:-15]],
}
"""Changes of the pictures of the third camera."""


def sabotaged(take: Path, folder: Path, fault: str) -> Path:
    """Copy a take with a fault."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    rig = marey.read_cameras(take)
    write_cameras_toml(CALIBRATIONS.get(fault, lambda rig: rig)(rig), folder / "cameras.toml")
    shutil.copytree(take / "background", folder / "background")
    for name in rig.names:
        shutil.copyfile(take / f"{name}.mp4", folder / f"{name}.mp4")
    if fault in VIDEOS:
        change, name = VIDEOS[fault], rig.names[2]
        rewrite(folder / f"{name}.mp4", change)
        plate = folder / "background" / f"{name}.png"
        cv2.imwrite(str(plate), change([cv2.imread(str(plate))] * 20)[-1])
    return folder


def rewrite(path: Path, change: Pictures) -> None:
    """Change the pictures of a video."""
    video = cv2.VideoCapture(str(path))
    rate, images = video.get(cv2.CAP_PROP_FPS), []
    while (read := video.read())[0]:
        images.append(read[1])
    changed = change(images)
    size = changed[0].shape[1], changed[0].shape[0]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate, size)
    for image in changed:
        writer.write(image)
    writer.release()


def row_of(run: Run, table: Table, name: str, fault: str) -> None:
    """Capture a take with a fault, and score what was captured."""
    take = run.shared / "data" / "people" / name
    place = run.out / "sabotage" / f"{name} {fault}"
    trial = sabotaged(take, place / "trial", fault)
    try:
        out = capture(trial, place / "out", frames=FRAMES)
    except marey.NotUsable as problem:
        table.row((name, fault), problem.verdict.level, cameras_of(problem.verdict), None, None, None)
        return
    verdict = marey.load_motion(out).verdict
    found = score(run, "capture.py", out, truth_of(take), "--skip-empty", EMPTY)
    shares = 100 * found["covered_95"], 100 * found["own_covered_95"]
    assert verdict is not None
    table.row((name, fault), verdict.level, cameras_of(verdict), found["joint_mm"], *shares)


def cameras_of(verdict: marey.Verdict) -> str:
    """The cameras that a verdict names."""
    return " ".join(dict.fromkeys(name for reason in verdict.reasons for name in reason.cameras)) or "-"


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("takes", nargs="*", default=TAKES, help="the takes")


def run(run: Run) -> None:
    """Capture each take with each fault."""
    columns = (
        Column("verdict"), Column("cameras named"), Column("joints", "mm", 1), Column("held", "%", 0),
        Column("held, in the limb's frame", "%", 0),
    )  # fmt: skip
    table = run.table("Planted faults", ("take", "fault"), *columns)
    for name in run.arguments.takes:
        for fault in ("none", *CALIBRATIONS, *VIDEOS):
            row_of(run, table, name, fault)
