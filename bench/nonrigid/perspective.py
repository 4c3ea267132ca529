"""Shapes before one camera in full perspective, its matrix known.

`paper`: the ten frames of nonrigid/paper_video whose points are given. `followed`: the same points followed through
the clip, rank constraint on: where they were seen, as `marey nonrigid` takes them; with 10 % of that hidden; with the
predicted places; and orthographic. `made`: sheets and bodies of `made_perspective`. `hidden`: the same with 5, 10 and
20 % of the places hidden, in runs of ten frames, or neighbours together for 10 % of the frames.
"""

import argparse

import cv2
import numpy as np

from bench.common.parts import add_parts, run_parts
from bench.declaration import Bench
from bench.nonrigid.made_perspective import KINDS, bending_sheet, deforming_body, filmed, hidden, rubber_sheet
from bench.recording import Column, Run, Table
from marey.arrays import Floats
from marey.geometry import rotations
from marey.images.matching.feature_tracks import follow_points
from marey.io.video.video import open_clip
from marey.nonrigid.core.alignment import mean_shape
from marey.nonrigid.core.rotation_paths import MIRROR
from marey.nonrigid.one_camera.one_view import factorise_tracks
from marey.nonrigid.one_camera.perspective import PerspectiveShapes, factorise_perspective
from marey.nonrigid.tracking.rank_tracking import refine_tracks

BENCH = Bench(
    measures="Shapes from one camera in full perspective, against true shapes.",
    sources=("src/marey/nonrigid", "src/marey/images/matching", "src/marey/geometry"),
    minutes=6,
)
NOTE = (
    "`shape_percent`: mean distance after one scale and a motion per frame, in percent of the greatest extent; no "
    "mirror image is "
    "allowed. *Mirror image worse by*: difference of the logarithms of probability. *Hold*: share within 1.96 "
    "stated standard "
    "deviations."
)
SEEDS = (0, 1)
SHARES = (0.05, 0.1, 0.2)


def percent(points: Floats, truth: Floats) -> float:
    """The mean distance after one scale and a motion a frame, in percent of the greatest extent."""
    a, b = (x - x.mean(2, keepdims=True) for x in (points, truth))
    turned = rotations.nearest(b @ np.swapaxes(a, 1, 2)) @ a
    scale = (turned * b).sum() / (turned**2).sum()
    return 100 * float(np.linalg.norm(scale * turned - b, axis=1).mean() / np.ptp(truth, axis=2).max())


def begin(run: Run, title: str) -> Table:
    """Begin a table of shapes."""
    return run.table(
        title, "sequence", Column("shape_percent", "%", 2), Column("K"), Column("noise", "px", 2),
        Column("distances change by", "", 4), Column("mirror image worse by", "", 0), Column("95 % hold, shape", "", 2),
        Column("95 % hold, turns", "", 2), note=NOTE,
    )  # fmt: skip


def row(
    table: Table, name: str, tracks: Floats, matrix: Floats, truth: Floats, frames: Floats | slice = slice(None)
) -> None:
    found = factorise_perspective(tracks, matrix)
    error = percent(found.points[frames], truth)
    values = error, found.rank, found.noise_sd, found.stretch, found.mirror_gap
    table.row(name, *values, *held(found, truth, frames))


def held(found: PerspectiveShapes, truth: Floats, frames: Floats | slice) -> tuple[float, float]:
    """The shares of coordinates and rotations within 95 % intervals, the truth divided and scaled as the result."""
    shape, rotation = found.shape[frames], found.rotation[frames]
    shape = shape - shape.mean(2, keepdims=True)
    points = np.swapaxes(truth - truth.mean(2, keepdims=True), 1, 2)
    _, camera_from_object, _ = mean_shape(points, np.ones(points.shape[:2], bool))
    true = np.swapaxes(points @ camera_from_object, 1, 2)
    rows, others = (x.transpose(1, 0, 2).reshape(3, -1) for x in (shape, true))
    axes = rotations.nearest(rows @ others.T)
    scale = np.sum(rows * (axes @ others)) / np.sum(others**2)
    wrong = np.abs(shape - scale * axes @ true)
    turn = np.abs(rotations.log(rotation @ axes @ np.swapaxes(camera_from_object, 1, 2)))
    sd = 1.96 * found.shape_sd[frames], 1.96 * found.rotation_sd[frames]
    return float(np.mean(wrong < sd[0])), float(np.mean(turn < sd[1]))


def paper(run: Run) -> None:
    """Factorise the given points."""
    shared, table = run.shared, begin(run, "Paper, ten frames, the given points")
    with np.load(shared / "data" / "nonrigid" / "paper_video" / "truth.npz") as truth:
        row(table, "paper, given points", truth["points2d"], truth["matrix"], truth["points3d"])


def followed(run: Run) -> None:
    """Follow the points, and factorise what was seen."""
    shared, table = run.shared, begin(run, "Paper, 191 frames, points followed")
    clip = open_clip(shared / "data" / "nonrigid" / "paper_video" / "video.mp4")
    pictures = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in clip.images(range(clip.count))]
    with np.load(shared / "data" / "nonrigid" / "paper_video" / "truth.npz") as truth:
        frames = truth["frames"].astype(int)
        points = follow_points(pictures, truth["points2d"][0].T, frame=int(frames[0]))
        found = refine_tracks(pictures, points).tracks
        seen = np.where(found.visible[:, None], found.tracks, np.nan)
        fewer = hidden(np.random.default_rng(0), seen, 0.1, together=True)
        for name, tracks in (("as seen", seen), ("10 % hidden", fewer), ("with predicted places", found.tracks)):
            row(table, f"paper, followed, {name}", tracks, truth["matrix"], truth["points3d"], frames)
        answer = factorise_tracks(seen)
        camera = (answer.rotation @ answer.shape)[frames]
        both = (percent(side, truth["points3d"]) for side in (camera, MIRROR @ camera))
        table.row("orthographic, the better mirror image", min(both), answer.rank, *[None] * 5)


def made(run: Run) -> None:
    """Film at three half extents: noise 0.5 px, 10 % missing in runs of ten frames, turns of about a radian."""
    table = begin(run, "Made sheets and bodies")
    for kind in KINDS:
        for seed in SEEDS:
            rng = np.random.default_rng(seed)
            tracks, matrix, points, _ = filmed(rng, _shapes(kind, rng), 1.0, 3.0, 660.0, 0.5, 0.1)
            row(table, f"{kind}, seed {seed}", tracks, matrix, points)


def with_hidden(run: Run) -> None:
    """Film as `made` does, and hide more and more."""
    table = begin(run, "Made sheets and bodies, places hidden")
    for kind in KINDS:
        rng = np.random.default_rng(SEEDS[0])
        tracks, matrix, points, _ = filmed(rng, _shapes(kind, rng), 1.0, 3.0, 660.0, 0.5, 0.0)
        for share in SHARES:
            for together in (False, True):
                fewer = hidden(np.random.default_rng(0), tracks, share, together=together)
                name = f"{kind}, {share:.0%} hidden {'together' if together else 'in runs'}"
                row(table, name, fewer, matrix, points)


def _shapes(kind: str, rng: np.random.Generator) -> Floats:
    makers = {"sheet": bending_sheet, "rubber": rubber_sheet}
    shapes = makers.get(kind, deforming_body)(rng)
    return np.repeat(shapes[:1], len(shapes), axis=0) if kind == "rigid" else shapes


PARTS = {"paper": paper, "followed": followed, "made": made, "hidden": with_hidden}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_parts(parser, PARTS)


def run(run: Run) -> None:
    """Run the parts."""
    run_parts(run, PARTS)
