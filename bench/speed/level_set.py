"""The level set on two lists beside scikit-image's methods: time and overlap on one image.

A textured room, a figure of capsules, an imperfect start. All methods get the same evidence: ours and the geodesic
contours as the log-ratio, both variants of Chan-Vese as an image of which they estimate the two means. The parameters
of the other methods are those with the largest overlap among a few values of each (smoothing and number of steps;
weight of the length and time step; scale of the gradient, threshold and balloon force), so that they are compared at
their best; ours are the program's defaults.
"""

import time
from collections.abc import Callable

import numpy as np
from scipy.ndimage import distance_transform_edt
from skimage.segmentation import (
    chan_vese,
    inverse_gaussian_gradient,
    morphological_chan_vese,
    morphological_geodesic_active_contour,
)

from bench.declaration import Bench
from bench.recording import Column, Run
from marey.images.silhouettes.level_sets import evolve, evolve_coarse_to_fine
from marey.images.silhouettes.silhouettes import SilhouetteSettings

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


def best(work: Callable[[], np.ndarray], repeats: int) -> tuple[np.ndarray, float]:
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        result = work()
        times.append(time.process_time() - begin)
    return result, 1e3 * min(times)


def two_regions(evidence: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Segment by Chan-Vese, whose regions have no fixed signs."""
    distance = distance_transform_edt(start) - distance_transform_edt(~start)
    found = chan_vese(evidence.astype(float), mu=0.05, max_num_iter=60, init_level_set=distance, tol=1e-4, dt=500)
    return found if (found & start).sum() > (~found & start).sum() else ~found


def run(run: Run) -> None:
    """Segment by all methods."""
    shape = (480, 640)
    truth, start = figure(shape), figure(shape, shift=8.0)
    evidence = np.where(truth, 2.0, -2.0) + np.random.default_rng(0).normal(0, 3, shape)
    evidence = np.clip(evidence, -10, 10).astype(np.float32)
    settings = SilhouetteSettings()
    methods: dict[str, tuple[Callable[[], np.ndarray], int]] = {
        "two lists": (lambda: evolve(evidence, start, length=settings.length), 20),
        "two lists, coarse to fine": (
            lambda: evolve_coarse_to_fine(evidence, start, length=settings.length, halvings=settings.halvings), 20,
        ),
        "Chan-Vese": (lambda: two_regions(evidence, start), 1),
        "morphological Chan-Vese, 20 steps": (
            lambda: morphological_chan_vese(evidence, 20, init_level_set=start, smoothing=3) > 0, 2,
        ),
        "morphological Chan-Vese, 40 steps": (
            lambda: morphological_chan_vese(evidence, 40, init_level_set=start, smoothing=3) > 0, 2,
        ),
        "morphological geodesic contours": (
            lambda: morphological_geodesic_active_contour(
                inverse_gaussian_gradient(evidence.astype(float), alpha=100, sigma=5), 30, init_level_set=start,
                smoothing=2, threshold=0.7,
            ) > 0, 2,
        ),
    }  # fmt: skip
    evolve(evidence, start, length=settings.length)
    table = run.table(
        "One picture of 640x480 pixels", "method", Column("processor time", "ms", 1), Column("IoU", "", 4)
    )
    for name, (work, repeats) in methods.items():
        mask, spent = best(work, repeats)
        table.row(name, spent, (mask & truth).sum() / (mask | truth).sum())
