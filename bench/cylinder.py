"""Least-squares matching on the real, speckled cylinder, beside an independent correlation program's matches.

    python bench/cylinder.py SHARED [OUT]

From `left_1` into `left_5` and `right_1`, for patches of several sizes, the points that the other program calls good.
The smallest patch starts up to a pixel from its matches, a larger one with the affine map of the smaller. `held` stays
on the epipolar lines of the given cameras. With OUT, `marey surface` measures all five positions, and a cylinder is
fitted to the points between the other program's outermost ones, leaving out what lies over 0.5 mm beside it.
"""

import sys
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import least_squares

from marey.cameras.epipolar import epipolar_lines
from marey.images.matching.matching import MatchSettings, match
from marey.images.matching.splines import SplinePicture, spline_of
from marey.io.calibration.readers import read_rig
from marey.io.shapes.measured_surface import read_surface
from marey.pipelines.surface.tasks import measure_surface
from marey.process import tuned_process
from marey.surface.points.measured import MeasuredPoints

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


def dense(folder: Path, out: Path, reference: np.lib.npyio.NpzFile) -> None:
    hull = cv2.convexHull(reference["points_left"][0].astype(np.float32))
    for size, spacing in ((13, 6), (21, 8)):
        measure_surface(folder, out=out, patch=size, spacing=spacing, tracks=False)
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
            told = stated(measured.of_frame(position)[inside][close], start, beside)
            cell = len(own) * spacing**2 / cv2.contourArea(hull)
            sys.stdout.write(
                f"position {position + 1}, {size}x{size}: {len(own)} points ({100 * cell:.0f} % of the speckle), "
                f"radius {1e3 * radius:.3f} mm, residual {1e3 * np.sqrt(np.mean(beside**2)):.3f} mm rms, "
                f"{100 * np.mean(~close):.2f} % left out; {told}\n"
            )


def stated(points: MeasuredPoints, start: np.ndarray, beside: np.ndarray) -> str:
    """Compare distances from the cylinder with the standard deviations stated for that direction."""
    axis = start[3:6] / np.linalg.norm(start[3:6])
    outward = points.points - start[:3]
    outward -= np.outer(outward @ axis, axis)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    ratio = np.abs(beside) / np.sqrt(np.einsum("ni,nij,nj->n", outward, points.covariance, outward))
    return f"{np.median(ratio) / 0.6745:.2f} times the stated sd, {100 * np.mean(ratio < 1.96):.0f} % within 1.96"


@tuned_process()
def main() -> None:
    folder, rng = Path(sys.argv[1]) / "data" / "surface" / "cylinder", np.random.default_rng(0)
    reference, template = np.load(folder / "reference.npz"), load(folder, "left_1")
    pixels = reference["points_left"][0]
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
            sys.stdout.write(
                f"{side}_{position} {size}x{size}: {100 * both.sum() / good.sum():.1f} % found, "
                f"{rms:.4f} px rms an axis from the other program (median distance {median:.4f}), stated {sd:.4f}\n"
            )
    first, second = read_rig(folder / "cameras.toml").cameras
    points, along = epipolar_lines(first, second, pixels, there)
    for size in (13, 21, 31):
        settings = MatchSettings(size=size)
        free = match(template, search, pixels, points, maps=maps, settings=settings)
        held = match(template, search, pixels, points, along=along, maps=maps, settings=settings)
        both = good & free.converged & held.converged
        apart = (held.pixels - free.pixels)[both]
        across = apart[:, 0] * along[both, 1] - apart[:, 1] * along[both, 0]
        forth = np.abs(np.sum(apart * along[both], axis=-1))
        sd = np.sqrt(np.einsum("ni,nij,nj->n", along[both], free.covariance[both], along[both]))
        sys.stdout.write(
            f"held, {size}x{size}: free matches lie {np.sqrt(np.mean(across**2)):.3f} px rms beside the lines; "
            f"along them both differ by {np.median(forth):.4f} px (median; stated sd {np.median(sd):.4f})\n"
        )

    if len(sys.argv) > 2:
        dense(folder, Path(sys.argv[2]), reference)


if __name__ == "__main__":
    main()
