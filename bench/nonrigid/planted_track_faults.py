"""Faults planted into tracks of one camera and points in space: whether `marey nonrigid` names them.

The tracks and true shapes of nonrigid/ (seven sequences), as given and with noise of 0.5 % of their size. `exchanged`:
two tracks from some frame on; it counts as named with both points and the frame. `zeros`: 5 % of the places are missing
and written as zeros; named if the count is right to 10 %. `frames exchanged` and `frame moved`: two frames exchanged,
one put at least five frames away. `repeated`: three frames equal to the one before. `order of names`: 1, 10, 11, 2.
`further`: findings beside the planted one. The thresholds were chosen on drink, pickup, stretch and face; yoga, dance
and shark_exact are held out.
"""

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from bench.declaration import Bench
from bench.recording import Column, Run
from marey.nonrigid.core.track_faults import ALL_BY_NAME, TrackFault, track_faults

BENCH = Bench(
    measures="Faults planted into tracks and points of deforming objects: named, further, and in sound ones.",
    sources=("src/marey/nonrigid/core/track_faults.py",),
    minutes=2,
)
SPLITS = {
    "drink": "chosen", "pickup": "chosen", "stretch": "chosen", "face": "chosen",
    "yoga": "held out", "dance": "held out", "shark_exact": "held out",
}  # fmt: skip
NOISE = 0.005
"""Standard deviation of the noise, as a share of that of all coordinates."""
DRAWS = 10
MISSING = 0.05
"""Share of the places that are written as zeros."""
MOVED = 5
"""Frames by which a frame is moved at least."""

Planted = tuple[np.ndarray, Callable[[TrackFault], bool]]
"""Tracks with a fault, and whether a finding names it."""


def exchanged(places: np.ndarray, rng: np.random.Generator) -> Planted:
    """Exchange two tracks from some frame on."""
    a, b = rng.choice(places.shape[2], 2, replace=False).tolist()
    first, wrong = int(rng.integers(2, len(places) - 2)), places.copy()
    wrong[first:, :, [a, b]] = wrong[first:, :, [b, a]]
    return wrong, lambda f: f.kind == "exchanged" and set(f.points) == {a, b} and f.frames[0] == first


def zeros(places: np.ndarray, rng: np.random.Generator) -> Planted:
    """Write missing places as zeros."""
    gone = rng.random((len(places), places.shape[2])) < MISSING
    count = int(gone.sum())
    return (
        np.where(gone[:, None], 0.0, places),
        lambda f: f.kind == "zeros" and abs(f.count - count) <= 0.1 * count,
    )


def frames_exchanged(places: np.ndarray, rng: np.random.Generator) -> Planted:
    """Exchange two frames."""
    pair, wrong = np.sort(rng.choice(np.arange(1, len(places) - 1), 2, replace=False)), places.copy()
    wrong[pair] = wrong[pair[::-1]]
    return wrong, lambda f: f.kind == "order"


def frame_moved(places: np.ndarray, rng: np.random.Generator) -> Planted:
    """Put one frame in another place."""
    frames = len(places)
    at = int(rng.integers(1, frames - 2))
    to = (at + int(rng.integers(MOVED, frames // 2))) % (frames - 1)
    order = np.insert(np.delete(np.arange(frames), at), to, at)
    return places[order], lambda f: f.kind == "order"


def repeated(places: np.ndarray, rng: np.random.Generator) -> Planted:
    """Repeat the frame before in three places."""
    wrong = places.copy()
    for frame in np.sort(rng.choice(np.arange(1, len(places)), 3, replace=False)):
        wrong[frame] = wrong[frame - 1]
    return wrong, lambda f: f.kind == "repeated" and f.count >= 2


def order_of_names(places: np.ndarray, rng: np.random.Generator) -> Planted:
    """Sort the frames by names without leading zeros, counted from 0 or 1."""
    start = int(rng.integers(2))
    by_name = np.argsort([str(n) for n in range(start, start + len(places))])
    return places[by_name], lambda f: f.kind == "order" and f.count == ALL_BY_NAME


FAULTS: dict[str, Callable[[np.ndarray, np.random.Generator], Planted]] = {
    "exchanged": exchanged, "zeros": zeros, "frames exchanged": frames_exchanged, "frame moved": frame_moved,
    "repeated": repeated, "order of names": order_of_names,
}  # fmt: skip


def sequences(shared: Path) -> Iterator[tuple[str, str, np.ndarray]]:
    """Yield the name of a sequence, what it has, and the coordinates (F, K, P)."""
    for name in SPLITS:
        with np.load(shared / "data" / "nonrigid" / f"{name}.npz") as file:
            yield name, "tracks", np.asarray(file["tracks"], float)
            yield name, "points in space", np.asarray(file["shape"], float)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--seed", type=int, default=0)


def run(run: Run) -> None:
    """Plant and look."""
    rng = np.random.default_rng(run.arguments.seed)
    clean = run.table("Sound sequences", ("split", "sequence", "given"), Column("frames"), Column("faults named"),
                      Column("with noise"))  # fmt: skip
    found: dict[tuple[str, str, str], np.ndarray] = {}
    for name, given, places in sequences(run.shared):
        noisy = places + rng.normal(0, NOISE * np.std(places), places.shape)
        named = [len(track_faults(each)) for each in (places, noisy)]
        clean.row((SPLITS[name], name, given), len(places), *named)
        for fault, plant in FAULTS.items():
            for _ in range(DRAWS):
                wrong, is_it = plant(places, rng)
                faults = track_faults(wrong)
                hits = sum(map(is_it, faults))
                counts = found.setdefault((SPLITS[name], name, fault), np.zeros(3, int))
                counts += (1, hits > 0, len(faults) - hits)
    table = run.table(
        "Planted faults, tracks and points in space together", ("split", "sequence", "fault"), Column("planted"),
        Column("named"), Column("further"),
    )  # fmt: skip
    for key, counts in found.items():
        table.row(key, *map(int, counts))
    total = run.table("All sequences", ("split", "fault"), Column("planted"), Column("named"), Column("further"))
    for split in ("chosen", "held out"):
        for fault in FAULTS:
            every = np.sum([each for key, each in found.items() if (key[0], key[2]) == (split, fault)], axis=0)
            total.row((split, fault), *map(int, every))
