"""Gadolinium markers in MR volumes.

`volumes`: the simulated volumes against their true centres, and two real ones without a marker. `spoilt`: the same
volumes cut in halves, averaged to coarser voxels, and with noise added. `made`: balls on a made limb, of many sizes,
voxels, noises and blurs, half of them beside fat nearly as bright.
"""

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tests.made_balls import limb_grid, limb_with_balls, on_skin

from bench.common.parts import add_parts, run_parts
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.io.mr.volumes import read_volume
from marey.knee.markers.gadolinium import Gadolinium, find_gadolinium, joined
from marey.knee.space.resampling import part_of
from marey.knee.space.volume import Volume, VoxelGrid

BENCH = Bench(
    measures="Centres of gadolinium balls in magnetic resonance images, against true centres.",
    sources=("src/marey/knee/markers", "src/marey/knee/space"),
    minutes=3,
)
NAMES = ("phantom_a", "phantom_spl", "phantom_spl_t1", "dess", "mese")
NEAR_MM = 2.0
NOISE = 8.0
DRAWS = 60
SPACINGS = ((0.4, 0.4, 1.4), (0.6, 0.6, 1.0), (0.8, 0.8, 0.8), (0.5, 0.5, 2.0))
RADII = (2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 9.5)


@dataclass(frozen=True, eq=False, kw_only=True)
class Found:
    """Errors (n, 3) of the markers that were found and (n, 3) what was stated, of how many, and the false ones."""

    errors_mm: np.ndarray
    sds_mm: np.ndarray
    true: int
    false: int
    inward_mm: np.ndarray
    """(n,) of the errors, how far towards z, the made limb's middle."""

    def cells(self) -> list[float | str | None]:
        """The figures of a row."""
        away = np.linalg.norm(self.errors_mm, axis=1)
        share = f"{len(away)} of {self.true}"
        if not len(away):
            return [share, self.false, None, None, None, None, None]
        hold = float((np.abs(self.errors_mm) < 1.96 * self.sds_mm).mean())
        rms, stated = float(np.sqrt((away**2).mean())), float(np.median(self.sds_mm))
        return [share, self.false, rms, float(away.max()), stated, hold, float(self.inward_mm.mean())]


FIGURES = (
    Column("found"),
    Column("false"),
    Column("error, RMS", "mm", 3),
    Column("worst", "mm", 3),
    Column("stated sd", "mm", 3),
    Column("95 % intervals hold", "", 2),
    Column("drawn inward", "mm", 3),
)


def compared(found: Gadolinium, true: np.ndarray) -> Found:
    apart = np.linalg.norm(true[:, None] - found.centres_mm[None], axis=2)
    hits = [(n, int(row.argmin())) for n, row in enumerate(apart) if row.size and row.min() < NEAR_MM]
    errors = np.array([found.centres_mm[m] - true[n] for n, m in hits]).reshape(-1, 3)
    sds = np.array([found.centres_sd_mm[m] for _, m in hits]).reshape(-1, 3)
    out = np.array([true[n] * (1, 1, 0) for n, _ in hits]).reshape(-1, 3)
    inward = -(errors * out).sum(1) / np.maximum(np.linalg.norm(out, axis=1), 1e-12)
    false = len(found) - len({m for _, m in hits})
    return Found(errors_mm=errors, sds_mm=sds, true=len(true), false=false, inward_mm=inward)


def image_of(knee: Path, name: str) -> Volume:
    return read_volume(knee / name if name == "mese" else knee / name / "image.nii.gz")


def volumes(run: Run) -> None:
    """Find the balls of the recordings."""
    table = run.table("Balls of the recordings", "volume", *FIGURES, Column("time", "s", 1))
    knee = run.shared / "data" / "knee"
    seen: dict[str, Gadolinium] = {}
    for name in NAMES:
        volume = image_of(knee, name)
        started = time.process_time()
        seen[name] = find_gadolinium(volume)
        seconds = time.process_time() - started
        table.row(name, *compared(seen[name], true_centres(knee / name)).cells(), seconds)
    both = joined(seen["phantom_spl"], seen["phantom_spl_t1"])
    table.row(
        "phantom_spl and phantom_spl_t1 joined", *compared(both, true_centres(knee / "phantom_spl")).cells(), None
    )


def true_centres(folder: Path) -> np.ndarray:
    truth = folder / "truth.json"
    if not truth.exists():
        return np.empty((0, 3))
    return np.array(json.loads(truth.read_text(encoding="utf-8"))["marker_centres_lps_mm"])


def spoilt(run: Run) -> None:
    """Find balls in halves, in coarser voxels, and under noise; a ball whose centre was cut off does not count."""
    table = run.table("Spoilt volumes", ("volume", "change"), Column("missed"), Column("in view"), Column("false"))
    knee = run.shared / "data" / "knee"
    for name in NAMES:
        true = true_centres(knee / name)
        for what, volume in spoilings(image_of(knee, name)):
            voxels = volume.grid.voxels(true)
            within = ((voxels >= 0) & (voxels < volume.grid.shape[::-1])).all(axis=1)
            found = find_gadolinium(volume)
            missed = len(true[within]) - len(compared(found, true[within]).errors_mm)
            table.row((name, what), missed, within.sum(), compared(found, true).false)


def spoilings(volume: Volume) -> list[tuple[str, Volume]]:
    halves = []
    for axis, letter in enumerate("kji"):
        middle = volume.grid.shape[axis] // 2
        for side, part in (("first", slice(0, middle)), ("second", slice(middle, None))):
            box = tuple(part if n == axis else slice(None) for n in range(3))
            cut = Volume(intensity=volume.intensity[box], grid=part_of(volume.grid, box))
            halves.append((f"{side} half along {letter}", cut))
    draw = np.random.default_rng(5)
    real, imaginary = (draw.normal(0, NOISE, volume.grid.shape) for _ in range(2))
    noisy = Volume(intensity=np.hypot(volume.intensity + real, imaginary), grid=volume.grid)
    return [*halves, ("voxels twice as wide in the slice", coarser(volume)), (f"noise of {NOISE:g} added", noisy)]


def coarser(volume: Volume) -> Volume:
    """Means of two by two voxels along j and i."""
    k, j, i = volume.grid.shape[0], volume.grid.shape[1] // 2, volume.grid.shape[2] // 2
    means = volume.intensity[:, : 2 * j, : 2 * i].reshape(k, j, 2, i, 2).mean(axis=(2, 4))
    lps_from_voxel = volume.grid.lps_from_voxel @ np.diag([2.0, 2, 1, 1])
    lps_from_voxel[:3, 3] = volume.grid.lps(np.array([0.5, 0.5, 0]))
    return Volume(intensity=means, grid=VoxelGrid(shape=(k, j, i), lps_from_voxel=lps_from_voxel))


def made(run: Run) -> None:
    """Find balls on made limbs."""
    table = run.table(f"{DRAWS} made limbs", "balls", *FIGURES)
    draw = np.random.default_rng(13)
    groups: dict[str, list[Found]] = {}
    for turn in range(DRAWS):
        kind, radius = ("dark", "bright")[turn % 2], float(draw.choice(RADII))
        grid = limb_grid(SPACINGS[draw.integers(len(SPACINGS))], turn=draw.uniform(0, 0.6))
        count = 5 if radius < 5 else 3
        angles = np.arange(count) * 2 * np.pi / count + draw.uniform(-0.2, 0.2, count)
        heights, sunk = draw.uniform(-1, 1, count) * (20 - radius), draw.uniform(0, 0.5, count)
        true = np.array([on_skin(*each) for each in zip(angles, heights, np.full(count, radius), sunk, strict=True)])
        noise, bias, blur_mm = draw.uniform(1, 8), draw.uniform(0, 0.3), float(draw.choice([0, 0.3, 0.6]))
        radii = np.full(count, radius)
        volume = limb_with_balls(grid, true, radii, kind, noise=noise, bias=bias, blur_mm=blur_mm, seed=turn)
        found = compared(find_gadolinium(volume), true)
        small = "radius 2 and 2.5 mm" if radius < 3 else "radius 3 to 5 mm" if radius < 6 else "radius 7 and 9.5 mm"
        blurred = (f"{kind} fat, blurred",) if blur_mm else ()
        for group in ("all", f"{kind} fat", *blurred, small):
            groups.setdefault(group, []).append(found)
    for group, each in groups.items():
        whole = Found(
            errors_mm=np.concatenate([one.errors_mm for one in each]),
            sds_mm=np.concatenate([one.sds_mm for one in each]),
            true=sum(one.true for one in each),
            false=sum(one.false for one in each),
            inward_mm=np.concatenate([one.inward_mm for one in each]),
        )
        table.row(group, *whole.cells())


PARTS = {"volumes": volumes, "spoilt": spoilt, "made": made}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_parts(parser, PARTS)


def run(run: Run) -> None:
    """Run the parts."""
    run_parts(run, PARTS)
