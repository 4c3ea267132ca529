"""The level set on two lists beside scikit-image's morphological Chan-Vese: time and overlap on one image.

A textured room, a figure of capsules, an imperfect start. Both get the same evidence where they can take it: ours the
log-ratio, Chan-Vese the evidence as its image (it estimates the two means itself).
"""

import time

import numpy as np
from skimage.segmentation import morphological_chan_vese

from bench.declaration import Bench
from bench.recording import Column, Run
from marey.images.silhouettes.level_sets import evolve

BENCH = Bench(
    measures="Time and overlap of the level set beside scikit-image, on a made picture.",
    sources=("src/marey/images/silhouettes",),
    minutes=1,
    data=False,
)
CAPSULES = (
    ((110, 320), (130, 320), 26), ((160, 320), (270, 320), 42), ((170, 285), (260, 235), 13),
    ((170, 355), (250, 420), 13), ((270, 305), (420, 290), 18), ((270, 335), (420, 355), 18),
)  # fmt: skip


def figure(shape: tuple[int, int], shift: float = 0.0) -> np.ndarray:
    y, x = np.indices(shape)
    mask = np.zeros(shape, bool)
    for (y0, x0), (y1, x1), radius in CAPSULES:
        along = np.array([y1 - y0, x1 - x0], float)
        share = np.clip(((y - y0) * along[0] + (x - x0 - shift) * along[1]) / (along @ along), 0, 1)
        mask |= (y - y0 - share * along[0]) ** 2 + (x - x0 - shift - share * along[1]) ** 2 <= radius**2
    return mask


def best(work, repeats: int) -> tuple[np.ndarray, float]:
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        result = work()
        times.append(time.process_time() - begin)
    return result, 1e3 * min(times)


def run(run: Run) -> None:
    """Segment by both."""
    shape = (480, 640)
    truth, start = figure(shape), figure(shape, shift=8.0)
    evidence = np.where(truth, 2.0, -2.0) + np.random.default_rng(0).normal(0, 3, shape)
    evidence = np.clip(evidence, -10, 10).astype(np.float32)
    evolve(evidence, start, length=4.0)
    ours, our_time = best(lambda: evolve(evidence, start, length=4.0), 20)
    theirs, their_time = best(lambda: morphological_chan_vese(evidence, 20, init_level_set=start, smoothing=2) > 0, 2)
    table = run.table(
        "One picture of 640x480 pixels", "method", Column("processor time", "ms", 1), Column("IoU", "", 4)
    )
    for name, mask, spent in (("two lists", ours, our_time), ("morphological Chan-Vese", theirs, their_time)):
        table.row(name, spent, (mask & truth).sum() / (mask | truth).sum())
