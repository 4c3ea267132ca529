"""Points of uncalibrated cameras matched by their motion alone: how many of them rightly.

    python bench/view_correspondence.py SHARED [NAME ...]

Real surfaces (the skin markers of SHARED/data/markers/sta, data of Cereatti et al. 2017, J Biomech, doi
10.1016/j.jbiomech.2017.02.004; the people of SHARED/data/nonrigid) are filmed by two orthographic cameras 20, 45 and
90 degrees apart about the vertical, each tilted and rolled at random by up to 17 degrees, with a scale and an order
of points of its own, noise of 0.5 % of the object's size, and a fifth of the points seen by one camera alone; seeds 0
to 2. Nothing of the cameras is told. Prints a row a case: the share of the points seen by both that got their right
partner (mean and worst take), wrong pairs of all pairs, and seconds of one processor a take. At last, how often pairs
are right by the probability they state. NAME keeps only cases whose name holds it.
"""

import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from marey.nonrigid.correspondence.view_correspondence import match_tracks
from marey.nonrigid.correspondence.view_joining import join_views

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
    """Give the markers (F, P, 3) of a trial in the laboratory [mm], as they are in each frame with a known bone."""
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
    """Give the rows (2, 3) of a camera that looks along the horizon, then is tilted and rolled."""
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


def two_views(shared: Path, names: list[str]) -> list[tuple[float, bool]]:
    """Print a row a case; give probability and truth of every pair."""
    stated = []
    for name, points, conditions in cases(shared):
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
        sys.stdout.write(
            f"{name} ({points.shape[1]} points): right {100 * np.mean(shares):.1f} %, worst take "
            f"{100 * min(shares):.0f} %, wrong {wrong} of {pairs} pairs, {seconds:.1f} s\n"
        )
        sys.stdout.flush()
    return stated


def three_views(shared: Path) -> None:
    """Join three cameras 45 degrees apart."""
    points = markers(shared, "lmam_treadmill_walking", ("thigh", "shank"))
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
    sys.stdout.write(
        f"three cameras joined, thigh and shank: right in all three {100 * np.mean(shares):.1f} %, worst take "
        f"{100 * min(shares):.0f} %, mixed points {mixed}\n"
    )


def main() -> None:
    shared, names = Path(sys.argv[1]), sys.argv[2:]
    with threadpool_limits(1):
        stated = two_views(shared, names)
        if not names:
            three_views(shared)
    probability, right = np.array(stated, float).T
    for low, high in pairwise(BINS):
        inside = (probability >= low) & (probability < high)
        if inside.any():
            sys.stdout.write(
                f"stated {low:.2f} to {min(high, 1):.2f}: {int(inside.sum())} pairs, right {right[inside].mean():.3f}, "
                f"stated on average {probability[inside].mean():.3f}\n"
            )


if __name__ == "__main__":
    main()
