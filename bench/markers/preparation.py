"""Trials of markers: how well they are filled, checked and prepared.

`gaps`: cut into measured paths, filled and compared. `exchanges`: labels exchanged on purpose, and false alarms.
`joints`: the hip's centre carried from a functional trial into walking.
"""

import argparse
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.common.parts import add_parts, run_parts
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.io.markers.readers import read_markers
from marey.markers.data.clusters import Cluster
from marey.markers.data.labels import clusters_from_names, find_clusters
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.preprocessing.exchanges import LabelExchange, find_exchanges, undo_exchanges
from marey.markers.preprocessing.functional import score, sphere_centre, transfer_point
from marey.markers.preprocessing.gaps import FROM_CLUSTER, SPLINE, fill_gaps, from_cluster, spline

BENCH = Bench(
    measures="Filled gaps, exchanged labels and joint centres of marker trials, against measured ones.",
    sources=("src/marey/markers", "src/marey/motion", "src/marey/io"),
    minutes=3,
)
PELVIS = ("LASI", "RASI", "LPSI", "RPSI")
HOW = {
    "one": "one segment, 10 % of the frames",
    "two": "two segments, 10 % of the frames",
    "all": "two segments, all frames",
}
LENGTHS = (5, 10, 24, 60, 120, 240)


def lmam(folder: Path) -> tuple[MarkerTrajectories, tuple[Cluster, ...]]:
    """The treadmill trial with the gaps that its measuring system left."""
    trial = read_markers(folder / "sta" / "lmam_treadmill_walking.c3d")
    points = np.array(trial.points)
    with np.load(folder / "sta" / "lmam_treadmill_walking.npz") as truth:
        for segment in truth["segments"]:
            raw = truth[f"{segment}_markers_with_gaps"]
            for m, label in enumerate(truth[f"{segment}_marker_names"]):
                points[np.isnan(raw[:, m]).any(-1), trial.labels.index(label)] = np.nan
    return replace(trial, points=points), find_clusters(trial.labels).clusters


def gaps(run: Run) -> None:
    folder = run.shared / "data" / "markers"
    trial, clusters = lmam(folder)
    columns = [Column(name, "mm", 2) for name in ("spline", "cluster", "chosen", "stated")]
    table = run.table(
        "RMS distance of filled points from the measured ones, beside the file's own gaps", ("markers", "gap [frames]"),
        *columns, Column("share filled by the spline", "", 2),
        note="*Chosen*: what `--fill best` takes. *Stated*: its own standard deviation.",
    )  # fmt: skip
    sparse = [Cluster(segment=c.segment, labels=c.labels[::5]) for c in clusters]
    for cluster in (*clusters, *sparse):
        rng, chosen = np.random.default_rng(5), trial.select(cluster.labels)
        for length in LENGTHS:
            cut = cuts(chosen, length, rng)
            holed = replace(chosen, points=np.where(cut[..., None], np.nan, chosen.points))
            filled = fill_gaps(holed, [cluster], largest_error_m=0.05)
            off = [
                rms(points, chosen.points, cut)
                for points in (
                    spline(holed.points), from_cluster(holed.points, filled.held_out[0].rank),
                    filled.trajectories.points,
                )
            ]  # fmt: skip
            stated = 1e3 * np.sqrt(3 * np.nanmean(filled.sd[cut] ** 2))
            share = (filled.way[cut] == SPLINE).sum() / max(1, np.isin(filled.way[cut], (SPLINE, FROM_CLUSTER)).sum())
            table.row((f"{cluster.segment}, {len(cluster.labels)}", str(length)), *off, stated, share)


def cuts(trial: MarkerTrajectories, length: int, rng: np.random.Generator) -> np.ndarray:
    """Places (F, M) of gaps of one length, one marker in ten at a time."""
    cut = np.zeros(trial.present.shape, bool)
    frames, count = cut.shape
    for draw in range(400):
        m, start = draw % count, int(rng.integers(1, frames - length))
        window = slice(start - 1, start + length + 1)
        free = (trial.present & ~cut)[window, m].all() and start + length < frames
        if free and cut[start : start + length].sum(1).max() < max(1, count // 10) and cut.sum() < 40 * length:
            cut[start : start + length, m] = True
    return cut


def rms(filled: np.ndarray, points: np.ndarray, cut: np.ndarray) -> float:
    return float(1e3 * np.sqrt(np.nanmean(((filled - points)[cut] ** 2).sum(-1))))


def exchanges(run: Run) -> None:
    folder = run.shared / "data" / "markers"
    columns = [Column(f"{how}: {what}") for how in HOW.values() for what in ("found", "others named")]
    table = run.table("Labels exchanged at random", "trial", Column("named in the original trial"), *columns)
    for path in sorted([*folder.glob("sta/*.c3d"), *folder.glob("functional/*.c3d"), *folder.glob("functional/*.trc")]):
        trial = read_markers(path)
        clusters = find_clusters(trial.labels).clusters
        if path.suffix == ".trc":
            clusters = clusters_from_names({"knee": ("*",)}, trial.labels).clusters
        seen = [
            Cluster(segment=c.segment, labels=tuple(x for x in c.labels if trial.select([x]).present.mean() > 0.5))
            for c in clusters
        ]
        alarms = len(find_exchanges(trial, clusters))
        rng, cells = np.random.default_rng(1), []
        for how in HOW:
            if how != "one" and len(seen) < 2:
                cells += [None, None]
                continue
            found = made = wrong = 0
            for _ in range(6):
                pair, frames = drawn(seen, how, len(trial), rng)
                broken = undo_exchanges(trial, [LabelExchange(labels=pair, frames=frames)])
                named = find_exchanges(broken, clusters)
                made += 1
                found += any(set(x.labels) == set(pair) for x in named)
                wrong += sum(set(x.labels) != set(pair) for x in named)
            cells += [f"{found} of {made}", wrong]
        table.row(path.stem, alarms, *cells)


def drawn(
    clusters: list[Cluster], how: str, count: int, rng: np.random.Generator
) -> tuple[tuple[str, str], np.ndarray]:
    """Draw a pair of labels and the frames in which they are exchanged: 10 % of the trial, or all of it."""
    frames = np.zeros(count, bool)
    start = int(rng.integers(0, max(1, count - count // 10)))
    frames[start : start + max(1, count // 10)] = True
    if how == "all":
        frames[:] = True
    if how == "one":
        first, second = rng.choice(clusters[rng.integers(len(clusters))].labels, 2, replace=False)
    else:
        a, b = rng.choice(len(clusters), 2, replace=False)
        first, second = rng.choice(clusters[a].labels), rng.choice(clusters[b].labels)
    return (str(first), str(second)), frames


def joints(run: Run) -> None:
    folder = run.shared / "data" / "markers"
    trial, walk = (read_markers(folder / "functional" / f"{name}.c3d") for name in ("left_hip", "walk"))
    thigh = [f"LF0{n}" for n in range(1, 6)]
    table = run.table(
        "Hip centre of `left_hip.c3d` carried into `walk.c3d`, against that file's own centre", "method",
        Column("median", "mm", 1), Column("largest", "mm", 1), Column("residual", "mm", 1), Column("stated sd [mm]"),
    )  # fmt: skip
    known = walk.select(["LeftHipCenterScore"]).points[:, 0]
    for name, find in (("SCoRE", score), ("sphere", sphere_centre)):
        centre = find(trial.select(PELVIS).points, trial.select(thigh).points)
        at = transfer_point(centre.parent_shape, centre.in_parent, walk.select(PELVIS).points)
        off = 1e3 * np.linalg.norm(at - known, axis=-1)
        sd = 1e3 * np.sqrt(np.diag(centre.covariance))
        table.row(name, np.median(off), off.max(), 1e3 * centre.residual, ", ".join(f"{v:.1f}" for v in sd))


PARTS = {"gaps": gaps, "exchanges": exchanges, "joints": joints}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_parts(parser, PARTS)


def run(run: Run) -> None:
    """Run the parts; a warning of the program is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run_parts(run, PARTS)
