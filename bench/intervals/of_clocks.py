"""Clocks of cameras: offsets and drifts that are planted in synchronous takes, and those of free-running cameras."""

from collections.abc import Iterator, Sequence

import numpy as np

from bench.capture.clocks import PLANS, RATE, TAKES, selected
from bench.intervals.scoring import Sample, single
from bench.recording import Run
from marey.cameras.clocks import Clocks
from marey.fit.clocks.estimate import estimate_clocks
from marey.fit.clocks.signals import EpipolarSignal
from marey.io.trial.trial import read_free_trial
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.sync.measurements import key_point_signals, silhouette_signals

DRIFT_SD = 1.64e-4
"""Standard deviation of planted drifts [s/s]: the median error of the clocks of 20 000 computers was 78 parts per
million ([Mills2006]), that of the difference of two is then 111."""


def samples(run: Run) -> Iterator[Sample]:
    """Estimate the clocks of every take from silhouettes and from detected joints."""
    for source, measure in (("silhouettes", silhouette_signals), ("key points", key_point_signals)):
        for name in TAKES:
            folder = run.shared / "data" / "people" / name
            keypoints = {"folder": str(folder / "keypoints")}
            trial = read_free_trial(folder, keypoints=keypoints if source == "key points" else None)
            signals = measure(trial, RecordingProgress())
            rng = np.random.default_rng(0)
            for step, first in PLANS:
                drift = np.append(0.0, rng.normal(0, DRIFT_SD, len(first) - 1))
                yield from planted(name, source, signals, trial.take.count, step, first, drift)
    folder = run.shared / "data" / "people" / "clocks"
    trial = read_free_trial(folder)
    signals = silhouette_signals(trial, RecordingProgress())
    with np.load(folder / "truth" / "truth.npz") as truth:
        rate, empty, drift = float(truth["rate"]), int(truth["empty"]), truth["drift"]
        offset = (truth["late_frames"] - empty * drift) / rate
    names = trial.rig.names
    times = [np.arange(clip.count) / rate for clip in trial.take.clips]
    yield from of_clocks("clocks", "silhouettes", estimate_clocks(names, times, signals).clocks, names, offset, drift)


def planted(
    case: str, source: str, signals: Sequence[EpipolarSignal], count: int, step: int, first: Sequence[int],
    drift: np.ndarray,
) -> Iterator[Sample]:  # fmt: skip
    """Estimate clocks of cameras that keep every so many pictures, each beginning with another one, and drift."""
    pictures, rate = [np.arange(begin, count, step) for begin in first], RATE / step
    names = [f"cam{c + 1:02d}" for c in range(len(first))]
    times = [np.arange(len(own)) / rate / (1 + each) for own, each in zip(pictures, drift, strict=True)]
    clocks = estimate_clocks(names, times, [selected(signal, pictures) for signal in signals]).clocks
    offset = (np.array(first) - first[0]) / RATE
    yield from of_clocks(case, source, clocks, names, offset, drift)


def of_clocks(
    case: str, source: str, clocks: Clocks, names: Sequence[str], offset: np.ndarray, drift: np.ndarray
) -> Iterator[Sample]:
    """Compare the clocks of all cameras but the first with the truth, offsets [s] and drifts."""
    kept = [names.index(name) for name in clocks.names][1:]
    off, slope = clocks.offset_s[1:] - offset[kept], clocks.drift[1:] - drift[kept]
    yield single(f"offsets, {source}", case, "ms", 1e3 * off, 1e3 * clocks.offset_sd_s[1:])
    yield single(f"drifts, {source}", case, "ppm", 1e6 * slope, 1e6 * clocks.drift_sd[1:])
