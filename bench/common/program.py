"""The program, the scores that were agreed on, and the takes that several benchmarks capture or measure."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from bench.recording import Run


def marey(*words: object) -> None:
    """Run the program in a process of its own.

    Raises:
        subprocess.CalledProcessError: If it ends with an error.
    """
    program = [sys.executable, "-c", "from marey.cli.main import main; main()"]
    subprocess.run([*program, *map(str, words)], check=True)


def capture(trial: Path, out: Path, *options: str) -> Path:
    """Run `marey capture` unless its results are there; the folder of the results."""
    if not (out / "run.json").exists():
        marey("capture", trial, "--out", out, "--no-overlay", "--quiet", *options)
    return out


def take(run: Run, name: str) -> tuple[Path, Path]:
    """Capture a take of data/people with the default settings; its trial and the results, shared by all benchmarks."""
    trial = run.shared / "data" / "people" / name
    return trial, capture(trial, run.out / "takes" / name)


def surface(trial: Path, out: Path, *options: str) -> Path:
    """Run `marey surface` unless its results are there; the folder of the results."""
    if not (out / "run.json").exists():
        marey("surface", trial, "--out", out, "--quiet", *options)
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
