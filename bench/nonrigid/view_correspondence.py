"""Points of uncalibrated cameras matched by their motion alone: the share of right matches.

Real surfaces (the skin markers of data/markers/sta, Cereatti et al. 2017, J Biomech, doi
10.1016/j.jbiomech.2017.02.004; the people of data/nonrigid) are filmed by two orthographic cameras 20, 45 and 90
degrees apart about the vertical, each tilted and rolled at random by up to 17 degrees, with a scale and an order of
points of its own, noise of 0.5 % of the object's size, and 20 % of the points seen by one camera alone; seeds 0 to 2.
Nothing about the cameras is given.
"""

import argparse
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.declaration import Bench
from bench.recording import Column, Run
from marey.nonrigid.correspondence.view_correspondence import match_tracks
from marey.nonrigid.correspondence.view_joining import join_views

BENCH = Bench(
    measures="Share of points of two uncalibrated cameras that are matched rightly by motion alone.",
    sources=("src/marey/nonrigid", "src/marey/geometry"),
    minutes=3,
)
ANGLES = (20, 45, 90)
SEEDS = range(3)
TILT = 0.3
"""Cameras are tilted and rolled by up to so much [rad]."""
BINS = (0.0, 0.5, 0.8, 0.95, 0.99, 1.001)


class Take(NamedTuple):
    """What the cameras saw, and which of the surface's points each track is."""

    views: list[np.ndarray]
    owners: list[np.ndarray]


def markers(shared: Path, trial: str, segments: tuple[str, ...]) -> np.ndarray:
    """The markers (F, P, 3) of a trial in the laboratory [mm], as they are in each frame with a known bone."""
    parts = []
    with np.load(shared / "data" / "markers" / "sta" / f"{trial}.npz") as file:
        for name in segments:
            rotation, origin, own = (file[f"{name}_{key}"] for key in ("rotation", "origin", "markers"))
            parts.append(np.einsum("fij,fpj->fpi", rotation, own) + origin[:, None])
    points = np.concatenate(parts, axis=1)
    return points[np.isfinite(points).all(axis=(1, 2))]


def people(shared: Path, name: str) -> np.ndarray:
    with np.load(shared / "data" / "nonrigid" / f"{name}.npz") as file:
        return np.swapaxes(file["shape"], 1, 2)


def camera(azimuth: float, tilt: float, roll: float) -> np.ndarray:
    """The rows (2, 3) of a camera that looks along the horizon, then is tilted and rolled."""
    forward = np.array([np.cos(azimuth) * np.cos(tilt), np.sin(azimuth) * np.cos(tilt), np.sin(tilt)])
    right = np.cross(forward, (0, 0, 1)) / np.cos(tilt)
    c, s = np.cos(roll), np.sin(roll)
    return np.array([[c, -s], [s, c]]) @ np.stack([right, np.cross(forward, right)])


def take(
    points: np.ndarray, angles: list[float], seed: int, noise: float = 0.005, alone: float = 0.2, gaps: float = 0.0
) -> Take:
    random = np.random.default_rng(seed)
    size = np.sqrt(np.mean(np.sum((points - points.mean(1, keepdims=True)) ** 2, axis=2)))
    start, count = random.uniform(0, 2 * np.pi), points.shape[1]
    lone = random.permutation(count)[: round(alone * count)]
    owner = random.integers(len(angles), size=len(lone))
    views, owners = [], []
    for number, angle in enumerate(angles):
        rows = camera(start + np.radians(angle), *random.uniform(-TILT, TILT, 2))
        scale, shift = random.uniform(0.7, 1.4), random.uniform(-500, 500, 2)
        own = random.permutation(np.setdiff1d(np.arange(count), lone[owner != number]))
        view = np.einsum("ij,fpj->fip", rows, points[:, own]) + shift[:, None]
        view = scale * (view + noise * size * random.normal(size=view.shape))
        views.append(hidden(view, gaps, random))
        owners.append(own)
    return Take(views, owners)


def hidden(view: np.ndarray, share: float, random: np.random.Generator) -> np.ndarray:
    """Take places out in runs of an eighth of the frames."""
    frames, _, points = view.shape
    gone = np.zeros((frames, points), bool)
    while gone.mean() < share:
        start = random.integers(frames)
        gone[start : start + max(1, frames // 8), random.integers(points)] = True
    return np.where(gone[:, None], np.nan, view)


def cases(shared: Path) -> Iterator[tuple[str, np.ndarray, dict[str, float]]]:
    thigh, shank = ("thigh",), ("shank",)
    walking = "lmam_treadmill_walking"
    surfaces = {
        f"{walking} thigh": markers(shared, walking, thigh),
        f"{walking} shank": markers(shared, walking, shank),
        f"{walking} both": markers(shared, walking, thigh + shank),
        "unibo_step_up thigh (13 frames)": markers(shared, "unibo_step_up", thigh),
        "unibo_step_up shank (13 frames)": markers(shared, "unibo_step_up", shank),
        "ottawa_walking thigh and shank": markers(shared, "ottawa_walking", thigh + shank),
        **{name: people(shared, name) for name in ("drink", "pickup", "stretch")},
    }
    for name, points in surfaces.items():
        yield name, points, {}
    for name, points in surfaces.items():
        if name in (f"{walking} both", "stretch"):
            yield f"{name}, noise 1.5 %", points, {"noise": 0.015}
            yield f"{name}, half of the points alone", points, {"alone": 0.5}
            yield f"{name}, a fifth missing in runs", points, {"gaps": 0.2}


def two_views(run: Run, names: list[str]) -> list[tuple[float, bool]]:
    """Match; stated probabilities, and whether each pair is right."""
    table = run.table(
        "Two cameras", "surface", Column("points"), Column("right", "%", 1), Column("worst take", "%", 0),
        Column("wrong pairs"), Column("time per take", "s", 1),
        note="*Right*: share of the points seen by both cameras that got their right partner, mean and worst take.",
    )  # fmt: skip
    stated = []
    for name, points, conditions in cases(run.shared):
        if names and not any(part in name for part in names):
            continue
        shares, wrong, pairs, started = [], 0, 0, time.process_time()
        for angle in ANGLES:
            for seed in SEEDS:
                views, owners = take(points, [0, angle], seed, **conditions)
                found = match_tracks(*views)
                right = owners[0][found.pairs[:, 0]] == owners[1][found.pairs[:, 1]]
                shares.append(right.sum() / len(np.intersect1d(*owners)))
                wrong, pairs = wrong + int((~right).sum()), pairs + len(right)
                stated += list(zip(found.probability, right, strict=True))
        seconds = (time.process_time() - started) / len(shares)
        table.row(name, points.shape[1], 100 * np.mean(shares), 100 * min(shares), f"{wrong} of {pairs}", seconds)
    return stated


def three_views(run: Run) -> None:
    """Join three cameras 45 degrees apart."""
    table = run.table(
        "Three cameras joined",
        "surface",
        Column("right in all three", "%", 1),
        Column("worst take", "%", 0),
        Column("mixed points"),
    )
    points = markers(run.shared, "lmam_treadmill_walking", ("thigh", "shank"))
    shares, mixed = [], 0
    for seed in SEEDS:
        views, owners = take(points, [0, 45, 90], seed)
        joined = join_views(views)
        named = np.where(joined.points >= 0, 0, -1)
        for number, own in enumerate(owners):
            seen = joined.points[number] >= 0
            named[number, seen] = own[joined.points[number, seen]]
        sets = [set(column[column >= 0]) for column in named.T]
        mixed += sum(len(names) > 1 for names in sets)
        full = sum(len(names) == 1 and (column >= 0).all() for names, column in zip(sets, named.T, strict=True))
        shares.append(full / len(set.intersection(*map(set, owners))))
    table.row("lmam_treadmill_walking thigh and shank", 100 * np.mean(shares), 100 * min(shares), mixed)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("names", nargs="*", help="only surfaces whose name contains one of these")


def run(run: Run) -> None:
    """Match, and compare probabilities with shares."""
    stated = two_views(run, run.arguments.names)
    if not run.arguments.names:
        three_views(run)
    table = run.table(
        "Stated probabilities of pairs",
        "stated",
        Column("pairs"),
        Column("right", "", 3),
        Column("stated on average", "", 3),
    )
    probability, right = np.array(stated, float).T
    for low, high in pairwise(BINS):
        inside = (probability >= low) & (probability < high)
        if inside.any():
            label = f"{low:.2f} to {min(high, 1):.2f}"
            table.row(label, int(inside.sum()), right[inside].mean(), probability[inside].mean())
