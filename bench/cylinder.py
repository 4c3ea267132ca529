"""Least-squares matching on the real, speckled cylinder, beside an independent correlation program's matches.

    python bench/cylinder.py SHARED

From `left_1` into `left_5` and `right_1`, for patches of several sizes, the points that the other program calls good.
The smallest patch starts up to a pixel from its matches, a larger one with the affine map of the smaller. `held` stays
on the epipolar lines of the given cameras.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from marey.cameras.epipolar import epipolar_lines
from marey.images.matching import MatchSettings, match
from marey.images.splines import SplinePicture, spline_of
from marey.io.calibration import read_rig

GOOD = 0.05


def load(folder: Path, name: str) -> SplinePicture:
    return spline_of(cv2.imread(str(folder / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE))


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


if __name__ == "__main__":
    main()
