"""Trajectories of a measured surface against the truth of a rendered take, and on a real, rigid cylinder.

    python bench/tracking.py careless SHARED OUT/careless        makes arm3 at half the size, as JPEG of quality 50
    python bench/tracking.py mirrored SHARED OUT/mirrored        makes arm3 as a mirror shows it: a left arm
    marey surface SHARED/data/people/arm3 --spacing 4 --out OUT/arm3
    marey surface OUT/careless --spacing 2
    marey surface SHARED/data/surface/cylinder --out OUT/cylinder

    python bench/tracking.py arm3 SHARED OUT/arm3                scores trajectories.npz
    python bench/tracking.py arm3 SHARED OUT/arm3 --case two     follows anew, started from surface.npz
    python bench/tracking.py arm3 SHARED OUT/careless/marey
    python bench/tracking.py cylinder SHARED OUT/cylinder

Cases: two (the two outer cameras), back (time reversed), every-second (half the rate), last (each frame matched to the
one before it alone, as in the paper), unfiltered, speed (of the tracking alone).
"""

import argparse
import json
import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.geometry.rigid import RigidTransform
from marey.io.calibration.readers import read_rig, write_cameras_toml
from marey.io.shapes.measured_surface import read_surface
from marey.io.shapes.trajectories import read_trajectories
from marey.io.video.take import Take, open_take
from marey.surface.points.measured import MeasuredPoints
from marey.surface.tracks.filters import FilterSettings, filtered
from marey.surface.tracks.following import ViewPatchSettings
from marey.surface.tracks.tracking import track
from marey.surface.tracks.trajectories import Trajectories, gathered, sightings_of

CASES = ("two", "back", "every-second", "last", "unfiltered", "speed")


def careless(shared: Path, folder: Path) -> None:
    """Write the take at half its size, with the artefacts of JPEG."""
    trial = shared / "data" / "people" / "arm3"
    rig = read_rig(trial / "cameras.toml")
    folder.mkdir(parents=True, exist_ok=True)
    for frame, images in open_take(trial, rig).frames():
        for name, image in zip(rig.names, images, strict=True):
            small = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            cv2.imwrite(str(folder / f"{name}_{frame:03d}.jpg"), small, [cv2.IMWRITE_JPEG_QUALITY, 50])
    for name in rig.names:
        plate = cv2.resize(cv2.imread(str(trial / "background" / f"{name}.png")), None, fx=0.5, fy=0.5)
        (folder / "background").mkdir(exist_ok=True)
        cv2.imwrite(str(folder / "background" / f"{name}.png"), plate)
    write_cameras_toml(rig.scaled(0.5), folder / "cameras.toml")
    (folder / "trial.toml").write_text("rate = 30.0\n")
    shutil.copytree(trial / "truth", folder / "truth", dirs_exist_ok=True)


def mirrored(shared: Path, folder: Path) -> None:
    """Write the take as a mirror shows it, with its truth: x goes to -x, right to left."""
    trial = shared / "data" / "people" / "arm3"
    rig = read_rig(trial / "cameras.toml")
    (folder / "background").mkdir(parents=True, exist_ok=True)
    (folder / "truth").mkdir(exist_ok=True)
    for frame, images in open_take(trial, rig).frames():
        for name, image in zip(rig.names, images, strict=True):
            cv2.imwrite(str(folder / f"{name}_{frame:03d}.jpg"), image[:, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])
    for name in rig.names:
        plate = cv2.imread(str(trial / "background" / f"{name}.png"))
        cv2.imwrite(str(folder / "background" / f"{name}.png"), plate[:, ::-1])
    write_cameras_toml(Rig(tuple(seen_in_a_mirror(camera) for camera in rig)), folder / "cameras.toml")
    (folder / "trial.toml").write_text("rate = 30.0\n")
    with np.load(trial / "truth" / "truth.npz") as file:
        truth = dict(file)
    for name in ("joints", "vertices"):
        truth[name] = truth[name] * np.array([-1, 1, 1], truth[name].dtype)
    truth["bone_rotation"] = FLIP @ truth["bone_rotation"] @ FLIP
    truth["faces"] = truth["faces"][:, ::-1]
    for name in ("joint_names", "limb_names"):
        truth[name] = np.array([swapped(str(label)) for label in truth[name]])
    np.savez_compressed(folder / "truth" / "truth.npz", **truth)


FLIP = np.diag([-1.0, 1, 1])


def seen_in_a_mirror(camera: Camera) -> Camera:
    pose, matrix, distortion = camera.camera_from_world, np.array(camera.matrix), np.array(camera.distortion)
    matrix[0, 2] = camera.width - 1 - matrix[0, 2]
    if len(distortion) > 3:
        distortion[3] = -distortion[3]
    turned = RigidTransform(FLIP @ pose.rotation @ FLIP, FLIP @ pose.translation)
    return replace(camera, matrix=matrix, distortion=distortion, camera_from_world=turned)


def swapped(label: str) -> str:
    """Name the other side's joint: l_elbow for r_elbow."""
    pairs = (("l_", "r_"), ("left", "right"), ("Left", "Right"), ("LHip", "RHip"), ("LThumb", "RThumb"))
    for here, there in (*pairs, *(pair[::-1] for pair in pairs)):
        if label.startswith(here):
            return there + label.removeprefix(here)
    return label


def score(shared: Path, found: Trajectories, order: list[int]) -> dict[str, float]:
    """Score trajectories whose frames show the truth's frames in an order of their own."""
    sys.path.insert(0, str(shared / "score"))
    import surface

    with np.load(shared / "data" / "people" / "arm3" / "truth" / "truth.npz") as file:
        truth = {"vertices": file["vertices"][order], "faces": file["faces"], "empty": np.array(0)}
    arrays = {name: np.asarray(getattr(found, name)) for name in ("position", "frames", "removed")}
    return {name: round(float(value), 3) for name, value in surface.score_tracks(arrays, truth).items()}


def followed(trial: Path, points: MeasuredPoints, case: str) -> tuple[Trajectories, list[int], float]:
    """Follow a measured surface anew; give the truth's frames, and points x views x frames a second."""
    rig = read_rig(trial / "cameras.toml")
    take = open_take(trial, rig)
    kept = [0, len(rig) - 1] if case == "two" else list(range(len(rig)))
    order = list(range(take.count))[:: {"back": -1, "every-second": 2}.get(case, 1)]
    settings = ViewPatchSettings(noise=1.5)
    if case == "last":
        settings = replace(settings, alike=1.0)
    cameras, sightings = [rig.cameras[i] for i in kept], []
    frames = [(number, grey) for number, grey in enumerate(pictures(take, order, kept))]
    started, count = time.process_time(), 0
    for tracks in track(frames, cameras, lambda n: of_cameras(points.of_frame(order[n]), kept), settings=settings):
        sightings.append(sightings_of(tracks))
        count += int(np.isfinite(sightings[-1].pixels[..., 0]).sum())
    spent = time.process_time() - started
    names = [rig.names[i] for i in kept]
    return gathered(sightings, np.arange(len(order)), rate=30.0, camera_names=names), order, count / spent


def pictures(take: Take, order: list[int], kept: list[int]) -> list[list[np.ndarray]]:
    """Read grey pictures in an order of their own."""
    read = {frame: [cv2.cvtColor(images[i], cv2.COLOR_BGR2GRAY) for i in kept] for frame, images in take.frames()}
    return [read[frame] for frame in order]


def of_cameras(points: MeasuredPoints, kept: list[int]) -> MeasuredPoints:
    """Forget what other cameras saw; the first of the kept ones stands for a template that is gone."""
    pixels, correlation = points.pixels[:, kept], np.array(points.correlation[:, kept])
    both = np.isfinite(pixels).all(axis=(1, 2))
    correlation[:, 0] = 1.0
    return MeasuredPoints(
        frame=points.frame[both], points=points.points[both], covariance=points.covariance[both],
        camera_names=tuple(points.camera_names[i] for i in kept), pixels=pixels[both], correlation=correlation[both],
        residual_px=points.residual_px[both], colour=points.colour[both],
    ) if len(kept) < len(points.camera_names) else points  # fmt: skip


def arm(shared: Path, folder: Path, case: str | None) -> None:
    """Score a run, or follow anew what it measured."""
    if case is None:
        found = read_trajectories(folder / "trajectories.npz")
        sys.stdout.write(json.dumps(score(shared, found, list(range(len(found.frames))))) + "\n")
        return
    trial = shared / "data" / "people" / "arm3"
    found, order, speed = followed(trial, read_surface(folder / "surface.npz"), case)
    if case != "unfiltered":
        found = filtered(found, FilterSettings()).trajectories
    sys.stdout.write(f"{case}: {json.dumps(score(shared, found, order))}, {speed:.0f} a second\n")


def cylinder(shared: Path, folder: Path) -> None:
    """Say how rigidly points move from one position to the others, and how far from the known steps."""
    with np.load(shared / "data" / "surface" / "cylinder" / "reference.npz") as file:
        turns, shifts = file["step_rotation"], file["step_translation_m"]
    found = read_trajectories(folder / "trajectories.npz")
    position = np.asarray(found.position[:, found.kept], float)
    for first, second in [(0, k) for k in range(1, 5)] + [(k, k + 1) for k in range(1, 4)]:
        both = np.isfinite(position[[first, second], :, 0]).all(axis=0)
        start, end = position[first, both], position[second, both]
        turn, shift = rigid(start, end)
        at_rest = (start - shifts[first]) @ turns[first]
        known = at_rest @ turns[second].T + shifts[second]
        moved = start @ turn.T + shift
        apart = [1e3 * np.sqrt(np.mean(np.sum(d**2, axis=1))) for d in (end - moved, moved - known, end - known)]
        sys.stdout.write(
            f"{first + 1} to {second + 1}: {both.sum()} points, {apart[0]:.4f} mm rms beside their rigid motion, which "
            f"differs from the known step by {apart[1]:.4f} mm rms at the points; together {apart[2]:.4f} mm\n"
        )


def rigid(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give the rotation and translation that carry points best."""
    middle, arrived = start.mean(axis=0), end.mean(axis=0)
    left, _, right = np.linalg.svd((end - arrived).T @ (start - middle))
    left[:, 2] *= np.sign(np.linalg.det(left @ right))
    return left @ right, arrived - left @ right @ middle


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("arm3", "careless", "mirrored", "cylinder"))
    parser.add_argument("shared", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--case", choices=CASES)
    asked = parser.parse_args()
    if asked.what == "careless":
        careless(asked.shared, asked.folder)
    elif asked.what == "mirrored":
        mirrored(asked.shared, asked.folder)
    elif asked.what == "cylinder":
        cylinder(asked.shared, asked.folder)
    else:
        arm(asked.shared, asked.folder, asked.case)


if __name__ == "__main__":
    main()
