"""Shapes from the tracks of one orthographic camera against the true ones, with one default for all sequences.

Without options the tracks are used unchanged. `--degraded` adds noise and gaps first, by score/degrade.py with seeds
0 to 2; `--plain` is the paper's own method instead, for 1 to 5 basis shapes; `--curve` shows, for degraded tracks of
seed 0, the criterion of each number of basis shapes and its true error; `--speed` times 100 points over 300 frames.
"""

import argparse
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from bench.common import program
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.geometry import rotations
from marey.nonrigid.one_camera.one_view import NonRigidShapes, factorise_tracks
from marey.nonrigid.one_camera.plain import PlainShapes, factorise_plainly

BENCH = Bench(
    measures="Shapes from the tracks of one orthographic camera, against true shapes of recorded motions.",
    sources=("src/marey/nonrigid", "src/marey/geometry"),
    minutes=3,
)

NAMES = ("drink", "pickup", "stretch", "face", "shark_exact", "dance", "yoga")
SEEDS = (0, 1, 2)
PLAIN_RANKS = (1, 2, 3, 4, 5)
ERRORS = (Column("metric A", "", 4), Column("framewise", "", 4), Column("K"))
HELD = (Column("95 % hold, shape", "", 3), Column("95 % hold, turns", "", 3))
NOTE = (
    "*Metric A* of Akhter et al. 2008: mean distance over mean standard deviation, one orthogonal matrix for the "
    "whole sequence; "
    "*framewise*: a rotation for each frame. *K*: number of basis shapes, chosen by the method. *Hold*: share of "
    "coordinates, and "
    "of turns of the camera, within 1.96 stated standard deviations."
)


def degraded(run: Run, source: Path, seed: int) -> Path:
    """Write tracks with 1 % noise and 20 % of the entries missing."""
    path = run.out / f"{source.stem}_{seed}.npz"
    script = run.shared / "score" / "degrade.py"
    subprocess.run([sys.executable, script, source, path, "--seed", str(seed)], check=True)
    return path


def intervals_hold(found: NonRigidShapes, truth: dict) -> float:
    """The share of the true coordinates within 1.96 standard deviations, after one rotation for all frames."""
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


def turns_hold(found: NonRigidShapes, truth: dict) -> float | None:
    """The share of the rotations within 1.96 standard deviations, after one rotation of the object."""
    if "rotation" not in truth:
        return None
    first = np.asarray(truth["rotation"], float)[:, :2]
    true = np.concatenate([first, np.cross(first[:, 0], first[:, 1])[:, None]], 1)
    mirror, share = np.diag([1.0, 1.0, -1.0]), []
    for rotation in (found.rotation, mirror @ found.rotation @ mirror):
        turn = rotations.mean(np.swapaxes(rotation, 1, 2) @ true)
        wrong = rotations.log(true @ np.swapaxes(rotation @ turn, 1, 2))
        share.append((float(np.square(wrong).sum()), float(np.mean(np.abs(wrong) < 1.96 * found.rotation_sd))))
    return min(share)[1]


def errors(run: Run, source: Path, found: NonRigidShapes | PlainShapes) -> tuple[float, float, int]:
    """Metric A, the framewise error and the number of basis shapes."""
    path = run.out / "shapes.npz"
    np.savez(path, shape=found.shape, rotation=found.rotation)
    scores = program.score(run, "nonrigid.py", path, source)
    return scores["metric_a"], scores["framewise"], found.rank


def shapes(run: Run, sources: list[Path]) -> None:
    """Factorise the tracks unchanged, or degraded."""
    table = run.table(
        "Shapes before one camera", ("sequence", "degraded"), *ERRORS, *HELD, Column("time", "s", 0), note=NOTE
    )
    for source in sources:
        truth = dict(np.load(source))
        for seed in SEEDS if run.arguments.degraded else (None,):
            tracks = source if seed is None else degraded(run, source, seed)
            started = time.process_time()
            found = factorise_tracks(np.load(tracks)["tracks"])
            seconds = time.process_time() - started
            held = intervals_hold(found, truth), turns_hold(found, truth)
            label = "no" if seed is None else f"seed {seed}"
            table.row((source.stem, label), *errors(run, source, found), *held, seconds)


def plain(run: Run, sources: list[Path]) -> None:
    """Factorise by the paper's own method: singular vectors twice."""
    table = run.table("Singular vectors twice, as in the paper", "sequence", *ERRORS, note=NOTE)
    for source in sources:
        for rank in PLAIN_RANKS:
            table.row(source.stem, *errors(run, source, factorise_plainly(np.load(source)["tracks"], rank)))


def curve(run: Run, sources: list[Path]) -> None:
    """For every number of basis shapes that is tried, the criterion and the true error."""
    columns = (*ERRORS, Column("criterion (least is taken)", "", 4), Column("taken"))
    table = run.table("Numbers of basis shapes, degraded with seed 0", ("sequence", "tried"), *columns, note=NOTE)
    for source in sources:
        tracks = np.load(degraded(run, source, 0))["tracks"]
        chosen = factorise_tracks(tracks)
        taken = chosen.rank_curve[np.argmin(chosen.rank_curve[:, 1]), 0]
        for rank, against in chosen.rank_curve:
            found = chosen if rank == taken else factorise_tracks(tracks, rank=int(rank))
            values = (*errors(run, source, found), against, "yes" if rank == taken else "")
            table.row((source.stem, f"{rank:.0f}"), *values)


def speed(run: Run) -> None:
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
    columns = (Column("processor time of one thread", "s", 1), Column("time", "s", 1), Column("K"))
    run.table("Duration", "made sequence", *columns).row("100 points, 300 frames", used, passed, found.rank)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("names", nargs="*", help=f"sequences of data/nonrigid; {', '.join(NAMES)} without any")
    for option in ("degraded", "plain", "curve", "speed"):
        parser.add_argument(f"--{option}", action="store_true")


def run(run: Run) -> None:
    """Factorise, and score."""
    given = run.arguments
    if given.speed:
        speed(run)
        return
    sources = [run.shared / "data" / "nonrigid" / f"{name}.npz" for name in given.names or NAMES]
    (plain if given.plain else curve if given.curve else shapes)(run, sources)
