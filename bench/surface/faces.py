"""Real faces from three cameras: share of the skin measured, how well rays meet, how well pairs of views agree.

`marey surface` measures instants 2 to 5 of `face1` together, and each alone, and the points are compared with the
facial skin that was outlined by hand. Pairs: the distance between the points of the left and middle camera and those
of the middle and right camera, for the same pixel of the middle image, by the corrected cameras and by the given
ones.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from bench.common.program import surface
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.cameras.rig import Rig
from marey.cameras.triangulate import triangulate
from marey.io.calibration.readers import read_rig
from marey.io.shapes.measured_surface import read_surface
from marey.surface.points.measured import MeasuredPoints

BENCH = Bench(
    measures="Coverage and agreement of surfaces of real faces; there is no true surface.",
    sources=("src/marey/cameras", "src/marey/images", "src/marey/surface", "src/marey/pipelines/surface"),
    minutes=8,
)

LEFT, MIDDLE, RIGHT = range(3)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--spacing", type=int, default=2, help="pixels from point to point")


def run(run: Run) -> None:
    """Measure, and compare."""
    data, spacing = run.shared / "data" / "surface" / "face1", run.arguments.spacing
    table = run.table(
        f"Faces, a point every {spacing} px",
        ("measured", "instant"),
        Column("skin measured", "%", 1),
        Column("in three views", "%", 1),
        Column("residual, median", "px", 2),
        Column("pairs agree within, median", "mm", 2),
        Column("95 %", "mm", 1),
        Column("by the given cameras, median", "mm", 2),
    )
    alone = [(f"alone_{k}", (k - 1, k), [k]) for k in (2, 3, 4, 5)]
    for name, frames, instants in (("together", (1, 5), [2, 3, 4, 5]), *alone):
        settings = {"frames": range(*frames), "spacing": spacing, "tracks": False}
        out = surface(data, run.out / "faces" / f"{name}_{spacing}", **settings)
        points, rig = read_surface(out / "surface.npz"), read_rig(data / "cameras.toml")
        for instant in instants:
            skin = cv2.imread(str(data / f"face_{instant}.png"), cv2.IMREAD_GRAYSCALE) > 0
            row = compared(points.of_frame(instant - 1), skin, spacing, rig, out / "corrected_cameras.toml")
            table.row(("together" if len(instants) > 1 else "alone", str(instant)), *row)


def compared(points: MeasuredPoints, skin: np.ndarray, spacing: int, given: Rig, corrected: Path) -> tuple[float, ...]:
    """The figures of one instant."""
    column, row = np.round(points.pixels[:, MIDDLE]).astype(int).T
    on_skin = points[skin[row, column]]
    whole = on_skin[on_skin.views == 3]
    rig = read_rig(corrected) if corrected.is_file() else given
    agree, by_given = (pairs(whole, each) for each in (rig, given))
    share = 100 * spacing**2 / skin.sum()
    return share * len(on_skin), share * len(whole), np.median(whole.residual_px), *agree, by_given[0]


def pairs(points: MeasuredPoints, rig: Rig) -> tuple[float, float]:
    found = [
        triangulate(
            [rig.cameras[i] for i in pair], points.pixels[:, list(pair)].swapaxes(0, 1), sigma_px=0.1
        ).points
        for pair in ((LEFT, MIDDLE), (MIDDLE, RIGHT))
    ]  # fmt: skip
    apart = 1e3 * np.linalg.norm(found[0] - found[1], axis=1)
    return float(np.median(apart)), float(np.percentile(apart, 95))
