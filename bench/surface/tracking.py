"""Trajectories of a measured surface against the truth of a rendered take, and on a real, rigid cylinder.

`arm3` scores what `marey surface` gives with a point every 4 px, then follows the same points again: every-second
(half the rate), two (the two outer cameras), last (each frame matched to the one before alone, as in the paper), back
(time reversed) and unfiltered. `careless` is the same film at half the size, each image stored as JPEG of quality
50; `mirrored` as a mirror shows it: a left arm. `cylinder` states how rigidly points move from one position to
another, and how far from the known steps. `covariance` follows the points of arm3 in several ways and compares their
distances from the true surface with the stated covariance.
"""

import argparse
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from bench.common.parts import add_parts, run_parts
from bench.common.program import score, surface
from bench.declaration import Bench
from bench.recording import Column, Run, Table
from bench.surface.arm import FRAMES, RATIOS, SURFACE, SURFACE_KEYS, TRACKS, TRACKS_KEYS, in_stated_sd, values_of
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

BENCH = Bench(
    measures="Trajectories of a rendered arm against its true surface, and of a real cylinder against known steps.",
    sources=("src/marey/cameras", "src/marey/images", "src/marey/surface", "src/marey/pipelines/surface"),
    minutes=25,
)

CASES = ("every-second", "two", "last", "back", "unfiltered")


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


def scored(shared: Path, found: Trajectories, order: list[int]) -> dict[str, float]:
    """Score trajectories whose frames show the truth's frames in an order of their own."""
    sys.path.insert(0, str(shared / "score"))
    import surface

    with np.load(shared / "data" / "people" / "arm3" / "truth" / "truth.npz") as file:
        truth = {"vertices": file["vertices"][order], "faces": file["faces"], "empty": np.array(0)}
    arrays = {name: np.asarray(getattr(found, name)) for name in ("position", "frames", "removed")}
    return {name: round(float(value), 3) for name, value in surface.score_tracks(arrays, truth).items()}


def followed(trial: Path, points: MeasuredPoints, case: str) -> tuple[Trajectories, list[int], float]:
    """Follow a measured surface again; the truth's frames, and points x views x frames per second."""
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
    """Read grey images in a given order."""
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


def arm(run: Run) -> None:
    """Score the trajectories of arm3, and follow its points again."""
    trial = run.shared / "data" / "people" / "arm3"
    out = surface(trial, run.out / "tracking" / "arm3", spacing=4)
    table = begin(run, "arm3, a point every 4 px")
    found = read_trajectories(out / "trajectories.npz")
    fill(table, "`marey surface`", scored(run.shared, found, list(range(len(found.frames)))))
    for case in CASES:
        found, order, speed = followed(trial, read_surface(out / "surface.npz"), case)
        if case != "unfiltered":
            found = filtered(found, FilterSettings()).trajectories
        fill(table, case, scored(run.shared, found, order), speed)


def begin(run: Run, title: str) -> Table:
    """Begin a table of trajectories."""
    return run.table(title, "case", *TRACKS, Column("points x views x frames per second of one core", "", 0))


def fill(table: Table, label: str, scores: dict, speed: float | None = None) -> None:
    """Append a row."""
    table.row(label, *values_of(TRACKS_KEYS, scores), speed)


def other_film(run: Run, name: str, make: Callable[[Path, Path], None], spacing: int) -> None:
    """Make another film of the arm, measure it, and score points and trajectories."""
    trial = run.out / "tracking" / f"{name}_trial"
    make(run.shared, trial)
    out, truth = surface(trial, run.out / "tracking" / name, spacing=spacing), trial / "truth" / "truth.npz"
    points = run.table(f"{name} film, points", "film", *SURFACE)
    points.row(name, *values_of(SURFACE_KEYS, score(run, "surface.py", out / "surface.npz", truth)))
    fill(
        begin(run, f"{name} film, trajectories"),
        name,
        score(run, "surface.py", "--tracks", out / "trajectories.npz", truth),
    )


COVERED_CASES = ("as it is", "two", "back")
"""Ways of following whose covariance is judged."""


def covariance(run: Run) -> None:
    """Compare the trajectories' distances from the true surface of arm3 with their stated covariance."""
    trial = run.shared / "data" / "people" / "arm3"
    points = read_surface(surface(trial, run.out / "tracking" / "arm3", spacing=4) / "surface.npz")
    with np.load(trial / "truth" / "truth.npz") as file:
        vertices, faces = file["vertices"].astype(float), file["faces"]
    table = run.table(
        "Trajectories of arm3: distances along the normal beside their stated standard deviations",
        ("case", "frame"), *RATIOS,
    )  # fmt: skip
    for case in COVERED_CASES:
        found, order, _ = followed(trial, points, case)
        found = filtered(found, FilterSettings()).trajectories
        for row in FRAMES:
            here = found.kept[np.isfinite(found.position[row, found.kept, 0])]
            position, spread = (np.asarray(array[row, here], float) for array in (found.position, found.covariance))
            ratios = in_stated_sd(run.shared, position, spread, vertices[order[row]], faces)
            table.row((case, str(row)), *ratios)


def cylinder(run: Run) -> None:
    """How rigidly points move from one position to the others, and how far from the known steps."""
    folder = run.shared / "data" / "surface" / "cylinder"
    out = surface(folder, run.out / "tracking" / "cylinder", spacing=8)
    with np.load(folder / "reference.npz") as file:
        turns, shifts = file["step_rotation"], file["step_translation_m"]
    found = read_trajectories(out / "trajectories.npz")
    table = run.table(
        "Cylinder", "from position to", Column("points"), Column("beside their rigid motion, RMS", "mm", 4),
        Column("that motion from the known step", "mm", 4), Column("together", "mm", 4),
    )  # fmt: skip
    position = np.asarray(found.position[:, found.kept], float)
    for first, second in [(0, k) for k in range(1, 5)] + [(k, k + 1) for k in range(1, 4)]:
        both = np.isfinite(position[[first, second], :, 0]).all(axis=0)
        start, end = position[first, both], position[second, both]
        turn, shift = rigid(start, end)
        at_rest = (start - shifts[first]) @ turns[first]
        known = at_rest @ turns[second].T + shifts[second]
        moved = start @ turn.T + shift
        apart = [1e3 * np.sqrt(np.mean(np.sum(d**2, axis=1))) for d in (end - moved, moved - known, end - known)]
        table.row(f"{first + 1} to {second + 1}", both.sum(), *apart)


def rigid(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rotation and translation that carry points best."""
    middle, arrived = start.mean(axis=0), end.mean(axis=0)
    left, _, right = np.linalg.svd((end - arrived).T @ (start - middle))
    left[:, 2] *= np.sign(np.linalg.det(left @ right))
    return left @ right, arrived - left @ right @ middle


PARTS = {
    "arm3": arm,
    "covariance": covariance,
    "careless": lambda run: other_film(run, "careless", careless, 2),
    "mirrored": lambda run: other_film(run, "mirrored", mirrored, 6),
    "cylinder": cylinder,
}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_parts(parser, PARTS)


def run(run: Run) -> None:
    """Run the parts."""
    run_parts(run, PARTS)
