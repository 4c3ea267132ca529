"""Least-squares matching beside OpenCV: speed and error on one made pair of images.

A texture of plane waves is filmed twice: the second time under an affine map (4 % of strain, 3 % of shear), gain 0.9
and offset 12, both with `--noise` grey levels of noise, rounded to whole ones. Starts lie up to a pixel from the
truth. `findTransformECC` finds the same affine map by the same criterion, `calcOpticalFlowPyrLK` the shift alone. The
second table compares the errors with the stated covariance, for textures of decreasing contrast.
"""

import argparse
import time
from collections.abc import Callable

import cv2
import numpy as np

from bench.declaration import Bench
from bench.recording import Column, Run, Table
from marey.images.matching.matching import MatchSettings, match
from marey.images.matching.splines import spline_of

BENCH = Bench(
    measures="Speed, error and stated covariance of patch matching on made pictures, beside OpenCV.",
    sources=("src/marey/images",),
    minutes=2,
    data=False,
)
SHAPE = (960, 1280)
MAP, SHIFT = np.array([[1.04, 0.03], [-0.02, 0.96]]), np.array([3.3, -2.7])
STEP, MARGIN, REPEATS = 4, 40, 7
ECC_PATCHES, ECC_WINDOW = 300, 14
SIZE = 13


def pictures(
    rng: np.random.Generator, noise: float, contrast: float = 30.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return both images, the patches' centres in the first one, and where they lie in the second one."""
    length, direction = np.exp(rng.uniform(np.log(5), np.log(30), 60)), rng.uniform(0, 2 * np.pi, 60)
    waves = 2 * np.pi / length[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=-1)
    phases = rng.uniform(0, 2 * np.pi, 60)

    def texture(places: np.ndarray) -> np.ndarray:
        total = np.zeros(places.shape[:-1])
        for wave, phase in zip(waves, phases, strict=True):
            total += np.cos(places @ wave + phase)
        return 120 + contrast * np.sqrt(2 / 60) * total

    y, x = np.indices(SHAPE, float)
    places, centre = np.stack([x, y], axis=-1), np.array(SHAPE[::-1]) / 2
    both = texture(places), 0.9 * texture((places - centre - SHIFT) @ np.linalg.inv(MAP).T + centre) + 12
    template, search = (np.clip(np.round(p + rng.normal(0, noise, SHAPE)), 0, 255).astype(np.uint8) for p in both)
    y, x = np.mgrid[MARGIN : SHAPE[0] - MARGIN : STEP, MARGIN : SHAPE[1] - MARGIN : STEP]
    pixels = np.stack([x.ravel(), y.ravel()], axis=-1).astype(float)
    return template, search, pixels, (pixels - centre) @ MAP.T + centre + SHIFT


def timed(
    work: Callable[[], tuple[np.ndarray, np.ndarray]], repeats: int
) -> tuple[np.ndarray, np.ndarray, list[float]]:
    spent = []
    for _ in range(repeats):
        begin = time.perf_counter()
        found, good = work()
        spent.append(time.perf_counter() - begin)
    return found, good, sorted(spent)


def report(table: Table, name: str, result: tuple[np.ndarray, np.ndarray, list[float]], truth: np.ndarray) -> None:
    found, good, spent = result
    error = np.sqrt(np.mean(np.sum((found[good] - truth[good]) ** 2, axis=-1)))
    rate, best = (good.sum() / seconds / 1000 for seconds in (spent[len(spent) // 2], spent[0]))
    table.row(name, rate, best, 100 * good.mean(), error)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--noise", type=float, default=1.0, help="grey levels")


def run(run: Run) -> None:
    """Match, and compare."""
    noise, rng = run.arguments.noise, np.random.default_rng(0)
    template, search, pixels, truth = pictures(rng, noise)
    starts = truth + rng.uniform(-1, 1, truth.shape)
    angle = rng.uniform(0, np.pi, len(truth))
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    on_line = truth + rng.uniform(-1, 1, (len(truth), 1)) * along
    splines, settings = (spline_of(template), spline_of(search)), MatchSettings(noise=noise, size=SIZE)
    cv2.setNumThreads(1)

    def ours(threads: int, *, new_splines: bool = False, lines: bool = False) -> tuple[np.ndarray, np.ndarray]:
        both = (spline_of(template), spline_of(search)) if new_splines else splines
        given = {"along": along} if lines else {}
        found = match(*both, pixels, on_line if lines else starts, settings=settings, threads=threads, **given)
        return found.pixels, found.converged

    def flow(levels: int) -> tuple[np.ndarray, np.ndarray]:
        found, good, _ = cv2.calcOpticalFlowPyrLK(
            template, search, pixels.astype(np.float32), starts.astype(np.float32), winSize=(SIZE, SIZE),
            maxLevel=levels, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01),
        )  # fmt: skip
        return found, good.ravel() > 0

    ours(2)  # compiles, or reads what was compiled before
    table = run.table(
        f"{len(pixels)} patches of {SIZE}x{SIZE} pixels, noise of {noise:g} grey levels, medians of {REPEATS} runs",
        "method",
        Column("patches per second", "1000", 0),
        Column("best", "1000", 0),
        Column("found", "%", 1),
        Column("error, RMS", "px", 4),
    )
    report(table, "two threads", timed(lambda: ours(2), REPEATS), truth)
    report(table, "two threads, splines of both pictures too", timed(lambda: ours(2, new_splines=True), REPEATS), truth)
    report(table, "one thread", timed(lambda: ours(1), REPEATS), truth)
    report(table, "one thread, along given lines", timed(lambda: ours(1, lines=True), REPEATS), truth)
    report(table, "`calcOpticalFlowPyrLK`, one thread, no pyramid", timed(lambda: flow(0), REPEATS), truth)
    few = rng.permutation(len(pixels))[:ECC_PATCHES]
    result = timed(lambda: correlated(template, search, pixels[few], starts[few]), 1)
    report(table, "`findTransformECC`, affine, one thread", result, truth[few])
    stated = run.table(
        "Errors beside the stated covariance", ("contrast [grey levels]", "centres beside whole pixels [px]"),
        Column("squared error over variance", "", 2), Column("mean error in x", "px", 3),
        Column("mean error in y", "px", 3), Column("error, RMS", "px", 4), Column("found", "%", 1),
    )  # fmt: skip
    for contrast in (30.0, 10.0, 5.0):
        compare_errors(stated, noise, contrast)


def compare_errors(table: Table, noise: float, contrast: float) -> None:
    """Compare errors with the stated covariance, for patches centred on whole pixels and beside them."""
    rng = np.random.default_rng(1)
    template, search, pixels, truth = pictures(rng, noise, contrast)
    splines = spline_of(template), spline_of(search)
    for beside in (0.0, 0.25):
        there = truth + MAP @ (beside, beside)
        found = match(*splines, pixels + beside, there, settings=MatchSettings(noise=noise, size=SIZE))
        good = found.converged
        errors, precision = (found.pixels - there)[good], np.linalg.inv(found.covariance[good])
        ratio = np.einsum("ni,nij,nj->n", errors, precision, errors) / 2
        rms = np.sqrt(np.mean(np.sum(errors**2, axis=-1)))
        table.row((f"{contrast:g}", f"{beside:g}"), ratio.mean(), *errors.mean(axis=0), rms, 100 * good.mean())


def correlated(
    template: np.ndarray, search: np.ndarray, pixels: np.ndarray, starts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Find patches with `findTransformECC`, one at a time in a window of the search image."""
    found, half = np.full_like(starts, np.nan), SIZE // 2
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 1e-4)
    for i, ((x, y), start) in enumerate(zip(pixels.astype(int), starts, strict=True)):
        patch = template[y - half : y + half + 1, x - half : x + half + 1]
        left, top = np.round(start).astype(int) - ECC_WINDOW
        window = search[top : top + 2 * ECC_WINDOW + 1, left : left + 2 * ECC_WINDOW + 1]
        warp = np.eye(2, 3, dtype=np.float32)
        warp[:, 2] = start - (left, top) - half
        try:
            _, warp = cv2.findTransformECC(patch, window, warp, cv2.MOTION_AFFINE, stop, None, 1)
        except cv2.error:
            continue
        found[i] = warp @ (half, half, 1) + (left, top)
    return found, np.linalg.norm(found - starts, axis=-1) < 4
