"""Runs that are killed at random moments, and the same command afterwards, against an undisturbed run.

A command is started as a process and receives SIGINT, SIGTERM or SIGKILL after a random time between the appearance of
its folder for checkpoints, or its start (`--from-start`), and its end. A moment is clean if the process ends without a
traceback (130 after SIGINT, 143 after SIGTERM, by the signal itself while the program starts or ends, 0 if the command
had ended before), if the folder of the results holds no file of the results or all of them, and if the same command
afterwards ends with exit code 0 and the bytes of the undisturbed run, and leaves no checkpoints. Compared are all files
whose bytes two undisturbed runs share: not run.json and the reports, which state times.
"""

import argparse
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from tests import scenes
from tests.made_animations import made_activity
from tests.made_knees import made_grid, made_volume
from tests.trials import marker_points, write_reference, write_trial

from bench.declaration import Bench
from bench.provenance import PROJECT
from bench.recording import Column, Run
from marey.geometry import rotations
from marey.io.calibration.readers import write_cameras_toml
from marey.io.mr.volumes import write_volume

BENCH = Bench(
    measures="Runs that are killed at random moments, and resumed: bytes of the results against an undisturbed run.",
    sources=(
        "src/marey/io/atomic.py",
        "src/marey/io/stages.py",
        "src/marey/io/work_folder.py",
        "src/marey/pipelines/run_record.py",
        "src/marey/__main__.py",
        "src/marey/cli/main.py",
    ),
    minutes=20,
    data=False,
)
SIGNALS = {"SIGINT": 130, "SIGTERM": 143, "SIGKILL": -9}
"""The signals, and the exit code after each."""
LIMIT_S = 600.0
"""Time after which a run counts as hanging [s]."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("commands", nargs="*", help=f"of {', '.join(COMMANDS)}; by default markers and nonrigid")
    parser.add_argument("--moments", type=int, default=20, help="number of moments per command")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--from-start", action="store_true", help="moments begin when the process starts")


def _markers(folder: Path) -> list[str]:
    write_trial(folder / "walk.c3d", marker_points(), force=True)
    write_reference(folder / "frame0.npz")
    return ["markers", "walk.c3d", "--reference", "frame0.npz", "--method", "rigid,skin"]


def _nonrigid(folder: Path) -> list[str]:
    rng, when = np.random.default_rng(3), np.arange(40)
    path = rotations.exp(np.outer(0.08 * when, [0.1, 1.0, 0.0]))
    mean, mode = 100 * rng.normal(size=(2, 3, 9))
    np.savez(folder / "cluster.npz", points=path @ (mean + 0.3 * np.sin(when / 7)[:, None, None] * mode))
    return ["nonrigid", "cluster.npz", "--basis-shapes", "2"]


def _surface(folder: Path) -> list[str]:
    rng, rig = np.random.default_rng(2), scenes.rig(-10, 0, 10)
    ball, trial = scenes.Ball.draw(rng), folder / "ball"
    trial.mkdir()
    write_cameras_toml(rig, trial / "cameras.toml")
    for camera in rig:
        writer = cv2.VideoWriter(str(trial / f"{camera.name}.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 25.0, scenes.SIZE)
        for _ in range(3):
            writer.write(ball.filmed(camera, rng))
        writer.release()
    return ["surface", "ball", "--spacing", "4"]


def _segment(folder: Path) -> list[str]:
    write_volume(folder / "knee.nii.gz", made_volume(made_grid((2.0, 2.0, 2.5)), "dark"))
    return ["knee", "segment", "knee.nii.gz", "--side", "left", "--seed", "femur", "0", "0", "30"]


def _animate(folder: Path) -> list[str]:
    made_activity(folder)
    return ["knee", "animate", "knee", "motion", "--reference", "standing.c3d"]


def _example(folder: Path, *words: str) -> list[str]:
    shutil.copytree(PROJECT / "examples" / "reach", folder / "reach")
    return [words[0], "reach", *words[1:]]


COMMANDS: dict[str, Callable[[Path], list[str]]] = {
    "markers": _markers,
    "nonrigid": _nonrigid,
    "capture": lambda folder: _example(folder, "capture", "--frames", "40:46", "--no-overlay"),
    "surface": _surface,
    "shape": lambda folder: _example(folder, "shape", "--frames", "40:42", "--no-overlay"),
    "segment": _segment,
    "animate": _animate,
}
"""The commands, each with a function that writes its inputs to a folder and returns its arguments."""


@dataclass
class _Counts:
    """What was found at the moments of one command and signal."""

    tried: int = 0
    before_end: int = 0
    clean: int = 0
    faults: list[str] = field(default_factory=list)


def run(run: Run) -> None:
    """Kill and repeat."""
    # A process in the background of a shell ignores Ctrl-C, and so would those that it starts.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    table = run.table(
        "Interrupted runs", ("command", "signal"), Column("moments"), Column("before the end"), Column("clean"),
        Column("failing"), Column("faults"),
    )  # fmt: skip
    rng = np.random.default_rng(run.arguments.seed)
    for command in run.arguments.commands or ("markers", "nonrigid"):
        folder = run.out / command
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        words, given = COMMANDS[command](folder), run.arguments
        for name, counts in _interrupted(words, folder, rng, given.moments, given.from_start).items():
            failing, faults = counts.tried - counts.clean, "; ".join(dict.fromkeys(counts.faults))
            table.row((command, name), counts.tried, counts.before_end, counts.clean, failing, faults)


def _interrupted(
    words: Sequence[str], folder: Path, rng: np.random.Generator, moments: int, from_start: bool
) -> dict[str, _Counts]:
    """Interrupt a command at random moments, with each signal in turn."""
    begin, end = _undisturbed(words, folder, "first")
    begin = 0.0 if from_start else begin
    _undisturbed(words, folder, "second")
    first, second = _content(folder / "first"), _content(folder / "second")
    wanted = {name: data if second.get(name) == data else None for name, data in first.items()}
    found = {name: _Counts() for name in SIGNALS}
    for number in range(moments):
        name = list(SIGNALS)[number % len(SIGNALS)]
        counts = found[name]
        counts.tried += 1
        fault, early = _at_moment(words, folder, name, float(rng.uniform(begin, end)), wanted)
        counts.before_end += early
        counts.clean += not fault
        counts.faults += [fault] if fault else []
    return found


def _start(words: Sequence[str], folder: Path, out: str) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "marey", *words, "--out", out, "-q"]
    return subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)


def _undisturbed(words: Sequence[str], folder: Path, out: str) -> tuple[float, float]:
    """Run a command; return when its folder for checkpoints appeared, and when it ended [s]."""
    started, appeared = time.monotonic(), np.nan
    process = _start(words, folder, out)
    while process.poll() is None:
        if np.isnan(appeared) and (folder / out / ".work").exists():
            appeared = time.monotonic() - started
        time.sleep(0.005)
    _, text = process.communicate()
    if process.returncode not in (0, 3):
        raise RuntimeError(f"{' '.join(words)} ended with {process.returncode}: {text}")
    end = time.monotonic() - started
    return (0.0 if np.isnan(appeared) else appeared), end


def _at_moment(
    words: Sequence[str], folder: Path, name: str, seconds: float, wanted: Mapping[str, bytes | None]
) -> tuple[str, bool]:
    """Interrupt one run and repeat it; return the first fault, and whether the run was interrupted before its end."""
    out = folder / "out"
    shutil.rmtree(out, ignore_errors=True)
    process = _start(words, folder, "out")
    time.sleep(seconds)
    process.send_signal(getattr(signal, name))
    try:
        _, text = process.communicate(timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return "does not end", True
    early = process.returncode not in (0, 3)
    if early and process.returncode not in (SIGNALS[name], -getattr(signal, name)):
        return f"exit code {process.returncode}", early
    if "Traceback" in text:
        return f"traceback that ends with {text.strip().splitlines()[-1]}", early
    there = {path for path in _content(out) if not path.startswith(".work")}
    if there and there != set(wanted) and name != "SIGKILL":
        return "a part of the results", early
    again = _start(words, folder, "out")
    _, text = again.communicate(timeout=LIMIT_S)
    if again.returncode not in (0, 3):
        return f"the same command again ends with {again.returncode}: {text.strip()[-200:]}", early
    return _difference(_content(out), wanted), early


def _difference(found: Mapping[str, bytes], wanted: Mapping[str, bytes | None]) -> str:
    if set(found) != set(wanted):
        return f"other files: {', '.join(sorted(set(found) ^ set(wanted))[:3])}"
    other = [name for name, data in wanted.items() if data is not None and found[name] != data]
    return f"other bytes: {', '.join(sorted(other)[:3])}" if other else ""


def _content(folder: Path) -> dict[str, bytes]:
    """Return the files of a folder by their relative names."""
    found = {}
    for base, _, names in os.walk(folder):
        for name in names:
            path = Path(base) / name
            found[path.relative_to(folder).as_posix()] = path.read_bytes()
    return found
