"""Shapes from the tracks of one camera against the true ones, by the agreed score, with one default for all.

    python bench/nonrigid.py SHARED OUT [NAME ...] [--degraded] [--plain] [--curve]

NAME is a sequence of SHARED/data/nonrigid (by default all with tracks). `--degraded` adds noise and gaps first, by
SHARED/score/degrade.py with seeds 0 to 2; `--plain` is the paper's own method instead, for 1 to 5 basis shapes;
`--curve` shows, after `degrade.py` with seed 0, what speaks against each number of basis shapes and its true error.
Prints a row a sequence: metric A, the number of basis shapes, the share of coordinates that the stated 95 % intervals
hold, and the processor time of one thread. `--speed` alone times 100 points over 300 frames.
"""

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from marey.geometry import rotations
from marey.nonrigid.one_camera.one_view import NonRigidShapes, factorise_tracks
from marey.nonrigid.one_camera.plain import PlainShapes, factorise_plainly

NAMES = ("drink", "pickup", "stretch", "face", "shark_exact")
SEEDS = (0, 1, 2)
PLAIN_RANKS = (1, 2, 3, 4, 5)


def degraded(shared: Path, source: Path, out: Path, seed: int) -> Path:
    path = out / f"{source.stem}_{seed}.npz"
    subprocess.run([sys.executable, shared / "score" / "degrade.py", source, path, "--seed", str(seed)], check=True)
    return path


def intervals_hold(found: NonRigidShapes, truth: dict) -> float:
    """Give the share of the truth's coordinates that 1.96 standard deviations hold, after one turn for all frames."""
    in_camera = str(truth.get("shape_frame", "")) == "camera"
    shape = found.rotation @ found.shape if in_camera else np.asarray(found.shape)
    sd = np.sqrt(found.rotation**2 @ found.shape_sd**2) if in_camera else np.asarray(found.shape_sd)
    true = np.asarray(truth["shape"], float)
    true, shape = true - true.mean(2, keepdims=True), shape - shape.mean(2, keepdims=True)
    share = []
    for sign in (1.0, -1.0):
        turned = shape * np.array([1.0, 1.0, sign])[:, None]
        a, b = (np.concatenate(list(x), 1) for x in (true, turned))
        u, _, vt = np.linalg.svd(a @ np.linalg.pinv(b))
        wrong = np.einsum("ji,fjp->fip", u @ vt, true) - turned
        share.append((float(np.square(wrong).sum()), float(np.mean(np.abs(wrong) < 1.96 * sd))))
    return min(share)[1]


def turns_hold(found: NonRigidShapes, truth: dict) -> str:
    """Say what share of the turns 1.96 standard deviations hold, after one turn of the object."""
    if "rotation" not in truth:
        return ""
    first = np.asarray(truth["rotation"], float)[:, :2]
    true = np.concatenate([first, np.cross(first[:, 0], first[:, 1])[:, None]], 1)
    mirror, share = np.diag([1.0, 1.0, -1.0]), []
    for rotation in (found.rotation, mirror @ found.rotation @ mirror):
        turn = rotations.mean(np.swapaxes(rotation, 1, 2) @ true)
        wrong = rotations.log(true @ np.swapaxes(rotation @ turn, 1, 2))
        share.append((float(np.square(wrong).sum()), float(np.mean(np.abs(wrong) < 1.96 * found.rotation_sd))))
    return f", of turns {min(share)[1]:.3f}"


def row(shared: Path, source: Path, name: str, found: NonRigidShapes | PlainShapes, out: Path) -> str:
    path = out / f"{name}_shapes.npz"
    np.savez(path, shape=found.shape, rotation=found.rotation)
    command = [sys.executable, shared / "score" / "nonrigid.py", path, source]
    result = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    return f"{name}: A {result['metric_a']:.4f}, framewise {result['framewise']:.4f}, K {found.rank}"


def score(shared: Path, source: Path, tracks: Path, out: Path) -> str:
    started = time.process_time()
    found = factorise_tracks(np.load(tracks)["tracks"])
    seconds = time.process_time() - started
    truth = dict(np.load(source))
    held = f"{intervals_hold(found, truth):.3f}{turns_hold(found, truth)}"
    return f"{row(shared, source, tracks.stem, found, out)}, 95 % intervals hold {held}, {seconds:.0f} s\n"


def curve(shared: Path, source: Path, name: str, out: Path) -> None:
    """Print for every number of basis shapes that is tried what speaks against it, and the error that it has."""
    tracks = np.load(degraded(shared, source, out, 0))["tracks"]
    chosen = factorise_tracks(tracks)
    taken = chosen.rank_curve[np.argmin(chosen.rank_curve[:, 1]), 0]
    for rank, against in chosen.rank_curve:
        found = chosen if rank == taken else factorise_tracks(tracks, rank=int(rank))
        mark = " <- taken" if rank == taken else ""
        sys.stdout.write(f"{row(shared, source, name, found, out)}, tried {rank:.0f}: {against:.4f}{mark}\n")
        sys.stdout.flush()


def speed() -> None:
    """Time a made sequence: 100 points over 300 frames, five displacements, 1 % of noise, nothing missing."""
    rng, time_ = np.random.default_rng(0), np.arange(300)
    path = rotations.exp(np.outer(0.05 * time_ + 0.2 * np.sin(time_ / 40), [0.1, 1.0, 0.05]))
    weights = np.array([0.3 / (k + 1) * np.sin(time_ / (9 + 7 * k) + k) for k in range(5)]).T
    shapes = rng.normal(size=(3, 100)) + np.einsum("fm,mip->fip", weights, rng.normal(size=(5, 3, 100)))
    tracks = (path @ shapes)[:, :2] + 0.01 * rng.normal(size=(300, 2, 100))
    factorise_tracks(tracks[:30, :, :20])  # compiles
    started, wall = time.process_time(), time.perf_counter()
    found = factorise_tracks(tracks)
    used, passed = time.process_time() - started, time.perf_counter() - wall
    sys.stdout.write(
        f"100 points, 300 frames: {used:.1f} s of one thread, {passed:.1f} s by the clock, K {found.rank}\n"
    )


def main() -> None:
    if "--speed" in sys.argv:
        speed()
        return
    options = {argument for argument in sys.argv[1:] if argument.startswith("--")}
    shared, out, *names = (argument for argument in sys.argv[1:] if argument not in options)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    for name in names or NAMES:
        source = Path(shared) / "data" / "nonrigid" / f"{name}.npz"
        given = [source]
        if "--plain" in options:
            for rank in PLAIN_RANKS:
                found = factorise_plainly(np.load(source)["tracks"], rank)
                sys.stdout.write(row(Path(shared), source, name, found, folder) + "\n")
            continue
        if "--curve" in options:
            curve(Path(shared), source, name, folder)
            continue
        if "--degraded" in options:
            given = [degraded(Path(shared), source, folder, seed) for seed in SEEDS]
        for tracks in given:
            sys.stdout.write(score(Path(shared), source, tracks, folder))
            sys.stdout.flush()


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
