"""Shapes from one, two and three uncalibrated cameras that stand fixed, against the true ones.

    python bench/many_views.py SHARED OUT sta [TRIAL SEGMENT]
    python bench/many_views.py SHARED OUT angles
    python bench/many_views.py SHARED OUT degraded
    python bench/many_views.py --speed

`sta`: the skin markers of SHARED/data/markers/sta (Cereatti et al. 2017) before orthographic cameras 45 degrees apart
round the vertical, from two sides each, with noise of 0.5 % of the cluster's size (root mean square of a coordinate).
`angles`: the moving bodies of SHARED/data/nonrigid before their own camera and a second one, 10 to 90 degrees from it.
`degraded`: the same 45 degrees apart, each camera's tracks made worse by SHARED/score/degrade.py (1 % noise, a fifth
of the entries missing). Errors: metric A of SHARED/score/nonrigid.py in the bone's or body's frame, then in the first
camera's, and with each frame aligned for itself; then the share of shapes (in the first of these frames) and of turns
that 95 % intervals hold, and by how much the cameras are off. `--speed` times 100 points, 300 frames and two cameras.
"""

import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from marey.errors import MareyError
from marey.geometry import rotations
from marey.nonrigid.many_cameras.many_views import ManyViewShapes, factorise_views
from marey.nonrigid.one_camera.one_view import NonRigidShapes, factorise_tracks

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


def errors(shared: Path, out: Path, found: NonRigidShapes | ManyViewShapes, take: Take) -> tuple[float, float, float]:
    camera = take.camera_from_world @ take.world_from_object
    centred = take.shape - take.shape.mean(2, keepdims=True)
    np.savez(out / "found.npz", shape=found.shape, rotation=found.rotation)
    np.savez(out / "object.npz", shape=centred)
    np.savez(out / "camera.npz", shape=camera @ centred, shape_frame="camera")
    scores = []
    for truth in ("object", "camera"):
        command = [sys.executable, shared / "score" / "nonrigid.py", out / "found.npz", out / f"{truth}.npz"]
        scores.append(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
    return scores[0]["metric_a"], scores[1]["metric_a"], scores[0]["framewise"]


def held(found: ManyViewShapes, take: Take, angles: tuple[float, ...]) -> str:
    """Say what share the 95 % intervals hold, and by how much the cameras' angles are off beside what is stated."""
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
    off = np.round(np.rad2deg(min(cameras, key=np.sum)), 2)
    stated = np.round(np.rad2deg(np.linalg.norm(found.camera_sd, axis=1)[1:]), 2)
    return f"held: shape {min(shares)[1]:.2f}, turns {min(turns)[1]:.2f}; cameras off by {off}, stated {stated} degrees"


def line(name: str, shared: Path, out: Path, take: Take, angles: tuple[float, ...]) -> str:
    return judged(name, shared, out, take, angles, take.tracks(angles, seed=len(angles)))


def degraded(shared: Path, out: Path, take: Take, angles: tuple[float, ...]) -> np.ndarray:
    """Give tracks with noise and gaps, each camera's own."""
    tracks = []
    for seed, camera in enumerate(take.tracks(angles, seed=0, noise=0.0)):
        np.savez(out / "camera_tracks.npz", tracks=camera)
        command = [sys.executable, shared / "score" / "degrade.py", out / "camera_tracks.npz", out / "degraded.npz"]
        subprocess.run([*command, "--seed", str(seed)], check=True)
        tracks.append(np.load(out / "degraded.npz")["tracks"])
    return np.stack(tracks)


def judged(name: str, shared: Path, out: Path, take: Take, angles: tuple[float, ...], tracks: np.ndarray) -> str:
    started = time.process_time()
    try:
        found = factorise_tracks(tracks[0]) if len(angles) == 1 else factorise_views(tracks)
    except MareyError as problem:
        return f"{name}, cameras {len(angles)}: no answer. {problem}\n"
    seconds = time.process_time() - started
    scores = ", ".join(f"{error:.4f}" for error in errors(shared, out, found, take))
    rest = "" if isinstance(found, NonRigidShapes) else f", {held(found, take, angles)}"
    return f"{name}, cameras {len(angles)}: {scores}, K {found.rank}{rest}, {seconds:.0f} s\n"


def speed() -> None:
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
    sys.stdout.write(f"2 cameras, 100 points, 300 frames: {used:.1f} s of one thread, {passed:.1f} s, K {found.rank}\n")


def main() -> None:
    if "--speed" in sys.argv:
        speed()
        return
    shared, out, what, *chosen = sys.argv[1:]
    Path(out).mkdir(parents=True, exist_ok=True)
    for trial in TRIALS if what == "sta" else ():
        for segment in ("thigh", "shank"):
            for side in SIDES if not chosen or chosen == [trial, segment] else ():
                take = skin(Path(shared), trial, segment, side)
                for angles in ((0,), (0, 45), (0, 45, 90)):
                    sys.stdout.write(line(f"{trial} {segment}, {side}", Path(shared), Path(out), take, angles))
                    sys.stdout.flush()
    for name in BODIES if what == "degraded" else ():
        take = body(Path(shared), name)
        tracks = degraded(Path(shared), Path(out), take, (0, 45))
        sys.stdout.write(judged(name, Path(shared), Path(out), take, (0, 45), tracks))
        sys.stdout.flush()
    for name in BODIES if what == "angles" else ():
        for angle in ANGLES:
            sys.stdout.write(line(f"{name}, {angle}", Path(shared), Path(out), body(Path(shared), name), (0, angle)))
            sys.stdout.flush()


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
