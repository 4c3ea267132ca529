"""Time the silhouettes of a trial, view by view, through the code that `marey capture` runs.

    python bench/views.py TRIAL RESULTS [--frames N]

RESULTS is the folder that a capture of the trial has left; its surface is where the outlines' level sets start, as in
the capture. Prints for both stages, first silhouettes and outlines, the processor's time for each picture after the
first of each camera that shows somebody: everything from the decoded picture to the silhouette. Edges inside of it,
which are looked for where the surface has rims, are no part of the level set and left out.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from marey.images.silhouettes.interior import InteriorEdges
from marey.io.trial.masks import open_masks
from marey.io.trial.trial import read_trial
from marey.pipelines.capture import stages
from marey.pipelines.progress import Progress
from marey.pipelines.speed.speeds import LEVEL_SET_LIMIT_MS


def main() -> None:
    """Print one JSON line a stage."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trial", type=Path)
    parser.add_argument("results", type=Path)
    parser.add_argument("--frames", type=int, default=40)
    asked = parser.parse_args()
    stages.quiet_threads()
    stages.keep_memory()
    trial, progress = read_trial(asked.trial), Progress(quiet=True)
    files = [open_masks(asked.results / "surface_masks" / f"{camera.name}.npz") for camera in trial.rig]
    with threadpool_limits(1):
        models, small = stages.backgrounds(trial, progress)
        surface = first_known(files, trial.take.first, trial.take.end, asked.frames)
        for name, cameras in (("silhouettes", small), ("outlines", list(trial.rig))):
            views = [stages.Watched(stages.shrunk(m, c.size)) for m, c in zip(models, cameras, strict=True)]
            spent: list[float] = []
            for frame, images in trial.take.at(list(surface)):
                starts = expected(surface[frame], cameras) if name == "outlines" else [None] * len(views)
                pictures = [stages.resized(image, camera) for image, camera in zip(images, cameras, strict=True)]
                started = time.thread_time()
                views = [stages.watch(*each) for each in zip(views, pictures, starts, strict=True)]
                spent.append(1e3 * (time.thread_time() - started) / len(views))
            later = np.array(spent[1:])
            print(json.dumps({
                "trial": asked.trial.name, "stage": name, "size": cameras[0].size, "pictures": later.size * len(views),
                "mean_ms": round(float(later.mean()), 2), "median_ms": round(float(np.median(later)), 2),
                "least_ms": round(float(later.min()), 2), "wanted_ms": LEVEL_SET_LIMIT_MS,
            }), flush=True)  # fmt: skip


def expected(masks, cameras) -> list:
    """Say where the body is believed, but of no rim inside of it."""
    none = InteriorEdges.none()
    return [stages.Expected(mask, none, camera) for mask, camera in zip(masks, cameras, strict=True)]


def first_known(files, first: int, end: int, count: int) -> dict:
    """Give the first frames in which every camera sees the surface: its silhouettes, one a camera."""
    found = {}
    for frame, masks in enumerate(zip(*(file.masks(range(first, end)) for file in files), strict=True), first):
        if all(mask.any() for mask in masks):
            found[frame] = masks
        if len(found) == count:
            break
    return found


if __name__ == "__main__":
    main()
