"""Shapes from one, two and three fixed, uncalibrated cameras, against the true ones.

`sta`: the skin markers of data/markers/sta (Cereatti et al. 2017, J Biomech, doi 10.1016/j.jbiomech.2017.02.004)
before orthographic cameras 45 degrees apart about the vertical, from two sides each, with noise of 0.5 % of the
cluster's size (root mean square of a coordinate). `angles`: the moving bodies of data/nonrigid before their own
camera and a second one, 10 to 90 degrees from it. `degraded`: the same 45 degrees apart, each camera's tracks
degraded by score/degrade.py (1 % noise, 20 % of the entries missing). `speed`: 100 points, 300 frames and two
cameras.
"""

import argparse
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.common import program
from bench.common.parts import add_parts, run_parts
from bench.declaration import Bench
from bench.recording import Column, Run, Table
from marey.errors import MareyError
from marey.geometry import rotations
from marey.nonrigid.many_cameras.many_views import ManyViewShapes, factorise_views
from marey.nonrigid.one_camera.one_view import NonRigidShapes, factorise_tracks

BENCH = Bench(
    measures="Shapes from one, two and three uncalibrated cameras, against true shapes.",
    sources=("src/marey/nonrigid", "src/marey/geometry"),
    minutes=6,
)
NOISE = 0.005
MIRROR = np.diag([1.0, 1.0, -1.0])
FRAMES = 310
"""At most so many frames are used, evenly spaced."""
TRIALS = {
    "lmam_treadmill_walking": (0, 0, 1),
    "ottawa_walking": (0, 0, 1),
    "unibo_step_up": (0, 1, 0),
}
"""Trials, and the laboratory's axis that points up."""
SIDES = (0, 90)
ANGLES = (10, 20, 45, 90)
BODIES = ("drink", "pickup", "stretch")


@dataclass
class Take:
    """Shapes (F, 3, P) in the object's frame, world from object (F, 3, 3), first camera from the world (3, 3)."""

    shape: np.ndarray
    world_from_object: np.ndarray
    camera_from_world: np.ndarray

    def tracks(self, angles: tuple[float, ...], seed: int, noise: float = NOISE) -> np.ndarray:
        """Show the shapes to cameras turned from the first about the images' upright."""
        points = self.world_from_object @ (self.shape - self.shape.mean(2, keepdims=True))
        rows = (turned(angles) @ self.camera_from_world)[:, :2]
        tracks = np.einsum("cij,fjp->cfip", rows, points)
        size = np.sqrt(np.mean(points**2))
        return tracks + np.random.default_rng(seed).normal(0, noise * size, tracks.shape)


def turned(angles: tuple[float, ...]) -> np.ndarray:
    return rotations.exp(np.outer(np.deg2rad(angles), [0.0, 1.0, 0.0]))


def skin(shared: Path, trial: str, segment: str, side: float) -> Take:
    data = np.load(shared / "data" / "markers" / "sta" / f"{trial}.npz")
    markers, rotation = data[f"{segment}_markers"], data[f"{segment}_rotation"]
    every = -(-len(markers) // FRAMES)
    markers, rotation = markers[::every], rotation[::every]
    down = -np.array(TRIALS[trial], float)
    across = np.roll(down, 1)
    base = np.stack([across, down, np.cross(across, down)])
    return Take(np.swapaxes(markers, 1, 2), rotation, turned((side,))[0] @ base)


def body(shared: Path, name: str) -> Take:
    data = np.load(shared / "data" / "nonrigid" / f"{name}.npz")
    rows, shape = data["rotation"].astype(float), data["shape"].astype(float)
    every = -(-len(shape) // (FRAMES + 60))
    rotation = np.concatenate([rows, np.cross(rows[:, 0], rows[:, 1])[:, None]], 1)
    return Take(shape[::every], rotation[::every], np.eye(3))


NOTE = (
    "Metric A in the bone's or body's frame / in the first camera's frame / with each frame aligned for itself. "
    "*Hold*: share of "
    "the shapes' coordinates and of the turns within 1.96 stated standard deviations. *Off*: how far each further "
    "camera's "
    "rotation is from the true one."
)


def errors(run: Run, found: NonRigidShapes | ManyViewShapes, take: Take) -> tuple[float, float, float]:
    camera = take.camera_from_world @ take.world_from_object
    centred = take.shape - take.shape.mean(2, keepdims=True)
    np.savez(run.out / "found.npz", shape=found.shape, rotation=found.rotation)
    np.savez(run.out / "object.npz", shape=centred)
    np.savez(run.out / "camera.npz", shape=camera @ centred, shape_frame="camera")
    in_object, in_camera = (
        program.score(run, "nonrigid.py", run.out / "found.npz", run.out / f"{truth}.npz")
        for truth in ("object", "camera")
    )
    return in_object["metric_a"], in_camera["metric_a"], in_object["framewise"]


def held(found: ManyViewShapes, take: Take, angles: tuple[float, ...]) -> tuple[float, float, str, str]:
    """Shares of shapes and rotations within 95 % intervals; errors of the cameras, and the stated ones [degrees]."""
    centred = take.shape - take.shape.mean(2, keepdims=True)
    shares = []
    for sign in (1.0, -1.0):
        shape = found.shape * np.array([1.0, 1.0, sign])[:, None]
        a, b = (np.concatenate(list(x), 1) for x in (centred, shape))
        u, _, vt = np.linalg.svd(a @ np.linalg.pinv(b))
        wrong = np.einsum("ji,fjp->fip", u @ vt, centred) - shape
        shares.append((np.square(wrong).sum(), np.mean(np.abs(wrong) < 1.96 * found.shape_sd)))
    true = take.camera_from_world @ take.world_from_object
    turns, cameras = [], []
    for mirror in (np.eye(3), MIRROR):
        rotation = mirror @ found.rotation @ mirror
        turn = rotations.mean(np.swapaxes(rotation, 1, 2) @ true)
        wrong = rotations.log(true @ np.swapaxes(rotation @ turn, 1, 2))
        turns.append((np.square(wrong).sum(), np.mean(np.abs(wrong) < 1.96 * found.rotation_sd)))
        relative = mirror @ found.camera_from_first @ mirror
        cameras.append(np.linalg.norm(rotations.log(turned(angles) @ np.swapaxes(relative, 1, 2)), axis=1)[1:])
    off, stated = (
        " ".join(f"{angle:.1f}" for angle in np.rad2deg(angles))
        for angles in (min(cameras, key=np.sum), np.linalg.norm(found.camera_sd, axis=1)[1:])
    )
    return min(shares)[1], min(turns)[1], off, stated


def begin(run: Run, title: str) -> Table:
    """Begin a table of shapes."""
    return run.table(
        title,
        ("object", "cameras"),
        Column("error"),
        Column("K"),
        Column("95 % hold, shape", "", 2),
        Column("95 % hold, turns", "", 2),
        Column("cameras off", "deg"),
        Column("stated", "deg"),
        Column("time", "s", 0),
        note=NOTE,
    )


def degraded_tracks(run: Run, take: Take, angles: tuple[float, ...]) -> np.ndarray:
    """Tracks with noise and gaps, each camera's own."""
    tracks = []
    for seed, camera in enumerate(take.tracks(angles, seed=0, noise=0.0)):
        np.savez(run.out / "camera_tracks.npz", tracks=camera)
        script = run.shared / "score" / "degrade.py"
        command = [sys.executable, script, run.out / "camera_tracks.npz", run.out / "degraded.npz"]
        subprocess.run([*command, "--seed", str(seed)], check=True)
        tracks.append(np.load(run.out / "degraded.npz")["tracks"])
    return np.stack(tracks)


def fill(
    run: Run, table: Table, name: str, take: Take, angles: tuple[float, ...], tracks: np.ndarray | None = None
) -> None:
    """Factorise, and append the scores."""
    tracks = take.tracks(angles, seed=len(angles)) if tracks is None else tracks
    label, started = (name, str(len(angles))), time.process_time()
    try:
        found = factorise_tracks(tracks[0]) if len(angles) == 1 else factorise_views(tracks)
    except MareyError as problem:
        table.row(label, f"no result: {problem}", *[None] * 6)
        return
    seconds = time.process_time() - started
    scores = " / ".join(f"{error:.3f}" for error in errors(run, found, take))
    more = (None,) * 4 if isinstance(found, NonRigidShapes) else held(found, take, angles)
    table.row(label, scores, found.rank, *more, seconds)


def sta(run: Run) -> None:
    table = begin(run, "Skin markers")
    for trial in TRIALS:
        for segment in ("thigh", "shank"):
            for side in SIDES:
                take = skin(run.shared, trial, segment, side)
                for angles in ((0,), (0, 45), (0, 45, 90)):
                    fill(run, table, f"{trial} {segment}, {side} degrees", take, angles)


def degraded(run: Run) -> None:
    table = begin(run, "Moving bodies, cameras 45 degrees apart, degraded tracks")
    for name in BODIES:
        take = body(run.shared, name)
        fill(run, table, name, take, (0, 45), degraded_tracks(run, take, (0, 45)))


def angles(run: Run) -> None:
    table = begin(run, "Moving bodies")
    for name in BODIES:
        for angle in ANGLES:
            fill(run, table, f"{name}, {angle} degrees", body(run.shared, name), (0, angle))


def speed(run: Run) -> None:
    """Time a made sequence before two cameras: 100 points, 300 frames, five displacements, 0.5 % of noise."""
    rng, frame = np.random.default_rng(0), np.arange(300)
    path = rotations.exp(np.stack([0.1 * np.sin(frame / 30), 0.5 * np.sin(frame / 40), 0.1 * np.cos(frame / 25)], 1))
    weights = np.array([0.2 / (k + 1) * np.sin(frame / (9 + 7 * k) + k) for k in range(5)]).T
    shapes = rng.normal(size=(3, 100)) + np.einsum("fm,mip->fip", weights, rng.normal(size=(5, 3, 100)))
    tracks = np.einsum("cij,fjp->cfip", turned((0, 45))[:, :2], path @ shapes)
    tracks = tracks + 0.005 * rng.normal(size=tracks.shape)
    factorise_views(tracks[:, :30, :, :12])  # compiles
    used, passed = time.process_time(), time.perf_counter()
    found = factorise_views(tracks)
    used, passed = time.process_time() - used, time.perf_counter() - passed
    columns = (Column("processor time of one thread", "s", 1), Column("time", "s", 1), Column("K"))
    run.table("Duration", "made sequence", *columns).row("2 cameras, 100 points, 300 frames", used, passed, found.rank)


PARTS = {"sta": sta, "angles": angles, "degraded": degraded, "speed": speed}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_parts(parser, PARTS)


def run(run: Run) -> None:
    """Run the parts."""
    run_parts(run, PARTS)
