"""The scores that were agreed on, and the captures and surfaces that several benchmarks measure."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

import marey
from bench.recording import Run


def capture(trial: Path, out: Path, **settings: Any) -> Path:
    """Capture a trial unless its results exist.

    Args:
        trial: The folder of the trial.
        out: The folder for the results.
        settings: Further arguments of `marey.capture`.

    Returns:
        The folder of the results.
    """
    if not (out / "run.json").exists():
        with marey.tuned_process():
            marey.capture(trial, out=out, overlay=False, progress=marey.RecordingProgress(), **settings)
    return out


def take(run: Run, name: str) -> tuple[Path, Path]:
    """Capture a take of data/people with the default settings; its trial and the results, shared by all benchmarks."""
    trial = run.shared / "data" / "people" / name
    return trial, capture(trial, run.out / "takes" / name)


def surface(trial: Path, out: Path, **settings: Any) -> Path:
    """Measure the surface of a trial unless its results exist.

    Args:
        trial: The folder of the trial.
        out: The folder for the results.
        settings: Further arguments of `marey.measure_surface`.

    Returns:
        The folder of the results.
    """
    if not (out / "run.json").exists():
        with marey.tuned_process():
            marey.measure_surface(trial, out=out, progress=marey.RecordingProgress(), **settings)
    return out


def shape(trial: Path, out: Path, **settings: Any) -> Path:
    """Fit a person's body to a trial, and to the measured surface if the folder of the results holds one.

    Args:
        trial: The folder of the trial.
        out: The folder for the results.
        settings: Further arguments of `marey.fit_shape`.

    Returns:
        The folder of the results.
    """
    with marey.tuned_process():
        marey.fit_shape(trial, out=out, overlay=False, progress=marey.RecordingProgress(), **settings)
    return out


def score(run: Run, script: str, *arguments: object) -> dict:
    """Run a script of the folder `score`; the numbers of its last line."""
    command = [sys.executable, str(run.shared / "score" / script), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    try:
        return json.loads(done.stdout)
    except json.JSONDecodeError:
        return json.loads(done.stdout.splitlines()[-1])


def empty_frames(trial: Path) -> int:
    """The number of leading frames of a rendered take that show no person."""
    truth = trial / "truth" / "truth.npz"
    return int(np.load(truth)["empty"]) if truth.exists() else 0


def truth_of(trial: Path) -> Path:
    """The reference of a take: rendered joints, or detected key points."""
    rendered = trial / "truth" / "truth.npz"
    return rendered if rendered.exists() else trial / "truth" / "keypoints3d.npz"
