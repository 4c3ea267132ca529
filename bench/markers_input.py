"""How well trials of markers are read, filled and checked, on real ones: `python bench/markers_input.py SHARED [PART]`.

Parts: gaps (cut into measured paths, filled, compared), exchanges (labels exchanged on purpose, and false alarms),
joints (the hip's centre carried from a functional trial into walking), events (of the gait, against given ones).
"""

import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from parts import run_parts

from marey.io.markers.c3d_forces import read_events, read_force_plates
from marey.io.markers.readers import read_markers
from marey.markers.data.clusters import Cluster
from marey.markers.data.labels import clusters_from_names, find_clusters
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.preprocessing.exchanges import LabelExchange, find_exchanges, undo_exchanges
from marey.markers.preprocessing.functional import score, sphere_centre, transfer_point
from marey.markers.preprocessing.gait_events import events_from_force, events_from_markers
from marey.markers.preprocessing.gaps import FROM_CLUSTER, SPLINE, fill_gaps, from_cluster, spline
from marey.motion.gait import STRIKE, GaitEvent

PELVIS = ("LASI", "RASI", "LPSI", "RPSI")
LENGTHS = (5, 10, 24, 60, 120, 240)


def main() -> None:
    run_parts(
        __doc__, {"gaps": gaps, "exchanges": exchanges, "joints": joints, "events": events}, within="data/markers"
    )


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


def gaps(folder: Path) -> None:
    trial, clusters = lmam(folder)
    print("RMS distance of filled points from the measured ones, mm; gaps beside the file's own")
    print("cluster          frames  spline  cluster  chosen  stated  spline's share")
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
            name = f"{cluster.segment}, {len(cluster.labels)}"
            print(f"{name:16} {length:6} {off[0]:7.2f} {off[1]:8.2f} {off[2]:7.2f} {stated:7.2f} {share:10.2f}")


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


def exchanges(folder: Path) -> None:
    print("trial, pairs exchanged in one cluster / between two / all along: found of made, others named by mistake")
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
        rng, told = np.random.default_rng(1), []
        for how in ("one", "two", "all"):
            if how != "one" and len(seen) < 2:
                continue
            found = made = wrong = 0
            for _ in range(6):
                pair, frames = drawn(seen, how, len(trial), rng)
                broken = undo_exchanges(trial, [LabelExchange(labels=pair, frames=frames)])
                named = find_exchanges(broken, clusters)
                made += 1
                found += any(set(x.labels) == set(pair) for x in named)
                wrong += sum(set(x.labels) != set(pair) for x in named)
            told.append(f"{how} {found}/{made}, {wrong}")
        print(f"{path.stem:24} alarms on the trial as it is: {alarms};  {';  '.join(told)}")


def drawn(
    clusters: list[Cluster], how: str, count: int, rng: np.random.Generator
) -> tuple[tuple[str, str], np.ndarray]:
    """Draw a pair of labels and the frames in which they are exchanged: a tenth of the trial, or all of it."""
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


def joints(folder: Path) -> None:
    trial, walk = (read_markers(folder / "functional" / f"{name}.c3d") for name in ("left_hip", "walk"))
    thigh = [f"LF0{n}" for n in range(1, 6)]
    known = walk.select(["LeftHipCenterScore"]).points[:, 0]
    for name, find in (("SCoRE", score), ("sphere", sphere_centre)):
        centre = find(trial.select(PELVIS).points, trial.select(thigh).points)
        at = transfer_point(centre.parent_shape, centre.in_parent, walk.select(PELVIS).points)
        off = 1e3 * np.linalg.norm(at - known, axis=-1)
        sd = 1e3 * np.sqrt(np.diag(centre.covariance))
        print(
            f"{name}: median {np.median(off):.1f} mm from LeftHipCenterScore, largest {off.max():.1f}; "
            f"residual {1e3 * centre.residual:.1f} mm, stated sd {sd[0]:.1f} {sd[1]:.1f} {sd[2]:.1f} mm"
        )


def events(folder: Path) -> None:
    path = folder / "functional" / "walk.c3d"
    walk, given = read_markers(path), read_events(path)
    body = walk.select(PELVIS).points.mean(1)
    feet = {side: walk.select([f"{side[0].upper()}HEE"]).points[:, 0] for side in ("left", "right")}
    force = events_from_force(read_force_plates(path), feet, rate=walk.rate, start_s=walk.start_s)
    found: list[GaitEvent] = []
    for side, heel in feet.items():
        toe = walk.select([f"{side[0].upper()}TOE"]).points[:, 0]
        found += events_from_markers(heel, body, rate=walk.rate, start_s=walk.start_s, side=side, toe=toe)
    compared("walk, markers against force plates", found, force)
    compared("walk, force plates against the file's events", force, given)
    compared("walk, markers against the file's events", found, given)
    trial, clusters = lmam(folder)
    thigh = np.nanmean(read_markers(folder / "sta" / "lmam_treadmill_walking.c3d").select(clusters[0].labels).points, 1)
    with np.load(folder / "sta" / "lmam_treadmill_walking.npz") as truth:
        strikes = [
            GaitEvent(kind=STRIKE, side=None, time=f / trial.rate, source="given") for f in truth["event_heel_strike"]
        ]
        heel = truth["heel_global"] * 1e-3
    compared("treadmill, heel against the file's strikes", events_from_markers(heel, thigh, rate=trial.rate), strikes)


def compared(name: str, found: list[GaitEvent] | tuple[GaitEvent, ...], known) -> None:
    """Print how many events have one of their kind within 100 ms, and how far that is."""
    off = []
    for event in known:
        same = [e.time - event.time for e in found if (e.kind, e.side) == (event.kind, event.side)]
        nearest = min(same, key=abs, default=np.inf)
        off += [1e3 * nearest] if abs(nearest) < 0.1 else []
    told = f"mean {np.mean(off):+.0f}, largest {np.max(np.abs(off)):.0f} ms" if off else "-"
    print(f"{name}: {len(off)} of {len(known)} found; {told}")


if __name__ == "__main__":
    warnings.simplefilter("error")
    sys.exit(main())
