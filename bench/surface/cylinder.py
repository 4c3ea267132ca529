"""Patch matching and surfaces of a real, speckled cylinder, beside an independent correlation program.

`matches`: from `left_1` into `left_5` and `right_1`, for patches of several sizes, the points that the other program
calls good. The smallest patch starts up to a pixel from its matches, a larger one with the affine map of the smaller.
A second table holds matches on the epipolar lines of the given cameras. `surface`: `marey surface` measures all five
positions, and a cylinder is fitted to the points between the other program's outermost ones, without those over 0.5
mm beside it.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import least_squares

from bench.common import program
from bench.common.parts import add_parts, run_parts
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.cameras.epipolar import epipolar_lines
from marey.images.matching.matching import MatchSettings, match
from marey.images.matching.splines import SplinePicture, spline_of
from marey.io.calibration.readers import read_rig
from marey.io.shapes.measured_surface import read_surface
from marey.surface.points.measured import MeasuredPoints

BENCH = Bench(
    measures="Matches and surfaces of a real speckled cylinder, against an independent program and a true cylinder.",
    sources=("src/marey/cameras", "src/marey/images", "src/marey/surface", "src/marey/pipelines/surface"),
    minutes=4,
)
GOOD = 0.05


def load(folder: Path, name: str) -> SplinePicture:
    return spline_of(cv2.imread(str(folder / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE))


def fitted_cylinder(points: np.ndarray, start: np.ndarray) -> tuple[float, np.ndarray]:
    """Fit a cylinder to points (n, 3) [m] from (point and direction of its axis, radius); radius and distances (n,)."""

    def distances(numbers: np.ndarray) -> np.ndarray:
        axis = numbers[3:6] / np.linalg.norm(numbers[3:6])
        return np.linalg.norm(np.cross(points - numbers[:3], axis), axis=1) - numbers[6]

    found = least_squares(distances, start, loss="soft_l1", f_scale=1e-4, x_scale=[0.01] * 3 + [0.1] * 3 + [0.01])
    return float(found.x[6]), distances(found.x)


def surface(run: Run) -> None:
    """Measure the five positions, and fit cylinders."""
    folder = run.shared / "data" / "surface" / "cylinder"
    reference = np.load(folder / "reference.npz")
    hull = cv2.convexHull(reference["points_left"][0].astype(np.float32))
    table = run.table(
        "`marey surface`, a cylinder fitted to the points of each position", ("position", "patch [px]"),
        Column("points"), Column("of the speckle", "%", 0), Column("radius", "mm", 3), Column("residual RMS", "mm", 3),
        Column("left out", "%", 2), Column("over the stated sd", "", 2), Column("within 1.96 sd", "%", 0),
    )  # fmt: skip
    for size, spacing in ((13, 6), (21, 8)):
        out = program.surface(folder, run.out / "cylinder" / str(size), patch=size, spacing=spacing, tracks=False)
        measured = read_surface(out / "surface.npz")
        for position in range(5):
            points = measured.of_frame(position)
            pixels = points.pixels[:, 0].astype(np.float32)
            inside = np.array([cv2.pointPolygonTest(hull, tuple(map(float, p)), True) > 20 for p in pixels])
            own = points.points[inside]
            near = reference["axis_point_m"][position], reference["axis_direction"][position]
            start = np.concatenate([*near, [0.057]])
            close = np.abs(fitted_cylinder(own, start)[1]) < 5e-4
            radius, beside = fitted_cylinder(own[close], start)
            cell = len(own) * spacing**2 / cv2.contourArea(hull)
            table.row(
                (str(position + 1), str(size)), len(own), 100 * cell, 1e3 * radius, 1e3 * np.sqrt(np.mean(beside**2)),
                100 * np.mean(~close), *stated(points[inside][close], start, beside),
            )  # fmt: skip


def stated(points: MeasuredPoints, start: np.ndarray, beside: np.ndarray) -> tuple[float, float]:
    """Compare distances from the cylinder with the standard deviations stated for that direction."""
    axis = start[3:6] / np.linalg.norm(start[3:6])
    outward = points.points - start[:3]
    outward -= np.outer(outward @ axis, axis)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    ratio = np.abs(beside) / np.sqrt(np.einsum("ni,nij,nj->n", outward, points.covariance, outward))
    return np.median(ratio) / 0.6745, 100 * np.mean(ratio < 1.96)


def matches(run: Run) -> None:
    """Match, and compare with the other program."""
    folder, rng = run.shared / "data" / "surface" / "cylinder", np.random.default_rng(0)
    reference, template = np.load(folder / "reference.npz"), load(folder, "left_1")
    pixels = reference["points_left"][0]
    table = run.table(
        "Matches beside the other program's", ("into", "patch [px]"), Column("found", "%", 1),
        Column("RMS per axis", "px", 4), Column("median distance", "px", 4), Column("stated sd", "px", 4),
    )  # fmt: skip
    for side, position in (("left", 5), ("right", 1)):
        there, search = reference[f"points_{side}"][position - 1], load(folder, f"{side}_{position}")
        good = reference[f"mismatch_{side}"][position - 1] < GOOD
        starts = there + rng.uniform(-1, 1, there.shape)
        maps = np.broadcast_to(np.eye(2), (len(pixels), 2, 2))
        for size in (13, 21, 31, 41):
            found = match(template, search, pixels, starts, maps=maps, settings=MatchSettings(size=size))
            maps = np.where(found.converged[:, None, None], found.search_from_template, maps)
            both = good & found.converged
            apart = (found.pixels - there)[both]
            rms, median = np.sqrt(np.mean(apart**2)), np.median(np.linalg.norm(apart, axis=-1))
            sd = np.sqrt(np.median(found.covariance[both][:, [0, 1], [0, 1]]))
            table.row((f"{side}_{position}", str(size)), 100 * both.sum() / good.sum(), rms, median, sd)
    first, second = read_rig(folder / "cameras.toml").cameras
    points, along = epipolar_lines(first, second, pixels, there)
    table = run.table(
        "Free matches beside those held on the epipolar lines of the given cameras", "patch [px]",
        Column("beside the lines, RMS", "px", 3), Column("along them, median", "px", 4), Column("stated sd", "px", 4),
    )  # fmt: skip
    for size in (13, 21, 31):
        settings = MatchSettings(size=size)
        free = match(template, search, pixels, points, maps=maps, settings=settings)
        held = match(template, search, pixels, points, along=along, maps=maps, settings=settings)
        both = good & free.converged & held.converged
        apart = (held.pixels - free.pixels)[both]
        across = apart[:, 0] * along[both, 1] - apart[:, 1] * along[both, 0]
        forth = np.abs(np.sum(apart * along[both], axis=-1))
        sd = np.sqrt(np.einsum("ni,nij,nj->n", along[both], free.covariance[both], along[both]))
        table.row(str(size), np.sqrt(np.mean(across**2)), np.median(forth), np.median(sd))


PARTS = {"matches": matches, "surface": surface}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_parts(parser, PARTS)


def run(run: Run) -> None:
    """Run the parts."""
    run_parts(run, PARTS)
