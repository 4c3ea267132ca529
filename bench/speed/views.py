"""Time of the silhouettes of a take, view by view, through the code that `marey capture` runs.

The take is captured first; its surface is where the outlines' level sets start, as in the capture. For both stages,
first silhouettes and outlines: the processor time for each image after the first of each camera that shows the
person, everything from the decoded image to the silhouette. Edges inside of it, which are searched where the
surface has rims, are no part of the level set and left out.
"""

import argparse
import time

import numpy as np

from bench.common import program
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.images.silhouettes.interior import InteriorEdges
from marey.io.trial.masks import open_masks
from marey.io.trial.trial import read_trial
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.silhouettes import stages
from marey.pipelines.silhouettes.empty_rooms import model_backgrounds, resized
from marey.pipelines.speed.speeds import LEVEL_SET_LIMIT_MS

BENCH = Bench(
    measures="Processor time of silhouettes and outlines, picture by picture.",
    sources=("src/marey/images/silhouettes", "src/marey/pipelines/capture"),
    minutes=2,
)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("takes", nargs="*", help="of data/people; reach, walk, stealth and jacks without any")
    parser.add_argument("--frames", type=int, default=40)


def run(run: Run) -> None:
    """Time both stages."""
    table = run.table(
        f"Silhouettes, picture by picture (limit {LEVEL_SET_LIMIT_MS:g} ms)", ("take", "stage"), Column("pictures"),
        Column("mean", "ms", 1), Column("median", "ms", 1), Column("least", "ms", 1),
    )  # fmt: skip
    for name in run.arguments.takes or ("reach", "walk", "stealth", "jacks"):
        folder, results = program.take(run, name)
        trial, progress = read_trial(folder), RecordingProgress()
        files = [open_masks(results / "surface_masks" / f"{camera.name}.npz") for camera in trial.rig]
        models, small = model_backgrounds(trial, progress)
        surface = first_known(files, trial.take.first, trial.take.end, run.arguments.frames)
        for stage, cameras in (("silhouettes", small), ("outlines", list(trial.rig))):
            views = [stages.SilhouetteState(stages.shrunk(m, c.size)) for m, c in zip(models, cameras, strict=True)]
            spent: list[float] = []
            for frame, images in trial.take.at(list(surface)):
                starts = expected(surface[frame], cameras) if stage == "outlines" else [None] * len(views)
                pictures = [resized(image, camera) for image, camera in zip(images, cameras, strict=True)]
                started = time.thread_time()
                views = [stages.update_silhouette(*each) for each in zip(views, pictures, starts, strict=True)]
                spent.append(1e3 * (time.thread_time() - started) / len(views))
            later = np.array(spent[1:])
            table.row((name, stage), later.size * len(views), later.mean(), np.median(later), later.min())


def expected(masks, cameras) -> list:
    """The expected silhouettes, without rims inside."""
    none = InteriorEdges.none()
    return [stages.Expected(mask, none, camera) for mask, camera in zip(masks, cameras, strict=True)]


def first_known(files, first: int, end: int, count: int) -> dict:
    """The first frames in which every camera sees the surface: its silhouettes, one a camera."""
    found = {}
    for frame, masks in enumerate(zip(*(file.masks(range(first, end)) for file in files), strict=True), first):
        if all(mask.any() for mask in masks):
            found[frame] = masks
        if len(found) == count:
            break
    return found
