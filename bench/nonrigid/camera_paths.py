"""Shapes from one camera on other paths: true shapes of the recordings filmed along made paths.

The objects are drink, pickup, stretch (their true shapes), leg, thigh (real skin markers on a treadmill), walk, jacks
and reach (50 points of rendered people). Each is filmed by five orthographic cameras: other (turns by 3 degrees per
frame about a tilted axis, in the other direction), slow (1.2 degrees), fast (9), swing (to and fro by 50 degrees in
140 frames) and hand (2 degrees with smooth random turns of 4). The tracks are degraded by score/degrade.py with seed
0. The error in the camera's frame counts: a slow turn of the object cannot be separated from one of an unsteady
camera.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bench.declaration import Bench
from bench.nonrigid.one_camera import ERRORS, HELD, NOTE, degraded, errors, intervals_hold, turns_hold
from bench.recording import Column, Run
from marey.arrays import Floats
from marey.geometry import rotations
from marey.nonrigid.one_camera.one_view import NonRigidShapes, factorise_tracks

BENCH = Bench(
    measures="Shapes from one orthographic camera on five made paths, against true shapes.",
    sources=("src/marey/nonrigid", "src/marey/geometry"),
    minutes=8,
)
PEOPLE = ("walk", "jacks", "reach")
SEQUENCES = ("drink", "pickup", "stretch")
LEG = ("leg", "thigh")
POINTS = 50
UPRIGHT = rotations.exp(np.array([-np.pi / 2, 0, 0])) @ np.eye(3)


def objects(data: Path, names: list[str]) -> Iterator[tuple[str, Floats]]:
    """Return names and shapes (F, 3, P), centred."""
    for name in names:
        if name in SEQUENCES:
            shapes = np.asarray(np.load(data / "nonrigid" / f"{name}.npz")["shape"], float)
            shapes = shapes[:720:2] if name == "drink" else shapes
        elif name in LEG:
            shapes = leg(np.load(data / "markers" / "sta" / "lmam_treadmill_walking.npz"), name)
        else:
            vertices = np.load(data / "people" / name / "truth" / "truth.npz")["vertices"]
            chosen = np.random.default_rng(5).choice(vertices.shape[1], POINTS, replace=False)
            shapes = vertices[:, chosen].transpose(0, 2, 1)
        yield name, shapes - shapes.mean(2, keepdims=True)


def leg(trial: dict, name: str) -> Floats:
    """The markers of thigh and shank, or of the thigh alone, in the room; markers with gaps are left out."""
    parts = []
    for segment in ("thigh", "shank")[: 2 if name == "leg" else 1]:
        turned = trial[f"{segment}_markers"] @ np.swapaxes(trial[f"{segment}_rotation"], 1, 2)
        parts.append(turned + trial[f"{segment}_origin"][:, None])
    markers = np.concatenate(parts, 1)
    return markers[:600:2, np.isfinite(markers).all((0, 2))].transpose(0, 2, 1)


def cameras(frames: int) -> Iterator[tuple[str, Floats]]:
    """Return names and rotations (F, 3, 3), camera from object."""
    time, rng = np.arange(frames)[:, None], np.random.default_rng(0)
    start = rotations.exp(np.array([0.3, 0.2, 0.1]))

    def orbit(degrees: float, axis: list[float]) -> Floats:
        return rotations.exp(np.radians(degrees) * time * np.array(axis) / np.linalg.norm(axis)) @ start

    window = np.exp(-0.5 * (np.arange(-20, 21) / 6) ** 2)
    shaken = np.stack([np.convolve(rng.normal(size=frames + 40), window, "valid") for _ in range(3)], 1)
    shaken *= np.radians(4) / shaken.std()
    swing = np.radians(50) * np.sin(2 * np.pi * time / 140) * np.array([0.1, 0.2, 1.0]) / np.linalg.norm([0.1, 0.2, 1])
    paths = {
        "other": orbit(-3, [0.3, 0.1, 1]), "slow": orbit(1.2, [0, 0.2, 1]), "fast": orbit(9, [0, 0, 1]),
        "swing": rotations.exp(swing) @ start, "hand": rotations.exp(shaken) @ orbit(2, [0.1, 0.3, 1]),
    }  # fmt: skip
    for name, path in paths.items():
        yield name, UPRIGHT @ path


def in_camera(found: NonRigidShapes, shapes: Floats, rotation: Floats) -> float:
    """The mean distance in the camera's frame over the mean standard deviation, the sign of depth free."""
    truth, got = rotation @ shapes, found.rotation @ found.shape
    got = got - got.mean(2, keepdims=True)
    mirror = np.array([1.0, 1.0, -1.0])[:, None]
    return min(float(np.linalg.norm(got * sign - truth, axis=1).mean()) for sign in (1, mirror)) / truth.std(2).mean()


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("objects", nargs="*", help=f"of {', '.join([*SEQUENCES, *LEG, *PEOPLE])}; all without any")


def run(run: Run) -> None:
    """Film, degrade, factorise, and score."""
    table = run.table(
        "Cameras on other paths", ("object", "path"), Column("camera's frame", "", 4), *ERRORS, *HELD, note=NOTE
    )
    names = run.arguments.objects or [*SEQUENCES, *LEG, *PEOPLE]
    for name, shapes in objects(run.shared / "data", names):
        for camera, rotation in cameras(len(shapes)):
            source = run.out / f"{name}_{camera}.npz"
            truth = {"tracks": (rotation @ shapes)[:, :2], "shape": shapes, "rotation": rotation[:, :2]}
            np.savez(source, **truth)
            found = factorise_tracks(np.load(degraded(run, source, 0))["tracks"])
            held = intervals_hold(found, truth), turns_hold(found, truth)
            table.row((name, camera), in_camera(found, shapes, rotation), *errors(run, source, found), *held)
