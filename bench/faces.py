"""Real faces from three cameras: how much of the skin is measured, how well rays meet, how well pairs of views agree.

    python bench/faces.py SHARED OUT [SPACING]

Runs `marey surface` on the instants 2 to 5 of `face1` together, and on each for itself, and compares with the facial
skin that was drawn by hand. Pairs: the distance between the points of left and middle and those of middle and right,
for the same pixel of the middle picture, from the pixels in surface.npz, by the corrected cameras and the given ones.
"""

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from marey.cameras.rig import Rig
from marey.cameras.triangulate import triangulate
from marey.io.calibration.readers import read_rig
from marey.io.shapes.measured_surface import read_surface
from marey.io.trial.trial import read_trial
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.surface.settings import SurfaceOptions
from marey.pipelines.surface.surface import surface_of_trial
from marey.process import tuned_process
from marey.surface.points.measured import MeasuredPoints

LEFT, MIDDLE, RIGHT = range(3)


@tuned_process()
def main() -> None:
    data, out = Path(sys.argv[1]) / "data" / "surface" / "face1", Path(sys.argv[2])
    spacing = int(sys.argv[3]) if len(sys.argv) > 3 else 2
    for name, options, instants in runs(out, spacing):
        surface_of_trial(read_trial(data, **options.changes()), options, RecordingProgress())
        rig = read_rig(data / "cameras.toml")
        corrected = out / name / "cameras.toml"
        points = read_surface(out / name / "surface.npz")
        for instant in instants:
            skin = cv2.imread(str(data / f"face_{instant}.png"), cv2.IMREAD_GRAYSCALE) > 0
            report(name, instant, points.of_frame(instant - 1), skin, spacing, rig, corrected)


def runs(out: Path, spacing: int) -> Iterator[tuple[str, SurfaceOptions, list[int]]]:
    shutil.rmtree(out, ignore_errors=True)
    for name, frames, instants in (
        ("together", (1, 5), [2, 3, 4, 5]),
        *((f"alone_{k}", (k - 1, k), [k]) for k in (2, 3, 4, 5)),
    ):
        yield name, SurfaceOptions(out=out / name, frames=frames, spacing=spacing, tracks=False), instants


def report(
    name: str, instant: int, points: MeasuredPoints, skin: np.ndarray, spacing: int, given: Rig, corrected: Path
) -> None:  # fmt: skip
    column, row = np.round(points.pixels[:, MIDDLE]).astype(int).T
    on_skin = points[skin[row, column]]
    whole = on_skin[on_skin.views == 3]
    rig = read_rig(corrected) if corrected.is_file() else given
    agree, by_given = (pairs(whole, each) for each in (rig, given))
    share = 100 * spacing**2 / skin.sum()
    sys.stdout.write(
        f"{name} face {instant}: {share * len(on_skin):.1f} % of the skin measured, "
        f"{share * len(whole):.1f} % in three views; residual {np.median(whole.residual_px):.3f} px "
        f"(all points of three views {np.median(points.residual_px[points.views == 3]):.3f}); pairs agree within "
        f"{agree[0]:.2f} mm median, {agree[1]:.2f} mm p95 (given cameras {by_given[0]:.2f}, {by_given[1]:.2f})\n"
    )


def pairs(points: MeasuredPoints, rig: Rig) -> tuple[float, float]:
    found = [
        triangulate(
            [rig.cameras[i] for i in pair], points.pixels[:, list(pair)].swapaxes(0, 1), sigma_px=0.1
        ).points
        for pair in ((LEFT, MIDDLE), (MIDDLE, RIGHT))
    ]  # fmt: skip
    apart = 1e3 * np.linalg.norm(found[0] - found[1], axis=1)
    return float(np.median(apart)), float(np.percentile(apart, 95))


if __name__ == "__main__":
    main()
