"""Harder takes made of rendered ones: frames left out, a person who leaves, images of noise.

`--every N` keeps each N-th frame, as a slower camera would. `--away A:B:N` shows the empty room for N frames in the
place of frames A to B, so that the person comes back elsewhere. `--noise A:B` shows nothing but noise in frames A to
B. Frames count from the first that shows the person. Without arguments the cases of `CASES` are made. The truth of
the remaining frames is scored.
"""

import argparse
import shutil
import tomllib
from pathlib import Path

import cv2
import numpy as np

from bench.capture.takes import MOTION, begin, fill
from bench.common.program import capture, empty_frames, score
from bench.declaration import Bench
from bench.recording import Run

BENCH = Bench(
    measures="Takes with a low frame rate, with an absent person and with pictures of noise, against rendered truth.",
    sources=(
        "src/marey/cameras",
        "src/marey/images",
        "src/marey/body",
        "src/marey/observations",
        "src/marey/fit",
        "src/marey/motion",
        "src/marey/pipelines/capture",
        "src/marey/pipelines/silhouettes",
    ),
    minutes=3,
)
CASES = (
    ("jacks", {"every": 6}),
    ("walk", {"away": "35:64:25"}),
    ("walk", {"noise": "40:55"}),
)
"""Takes and how they are made harder."""

EMPTY, NOISE = -1, -2


def pictures(clip: Path) -> list[np.ndarray]:
    """Read a clip."""
    video, found = cv2.VideoCapture(str(clip)), []
    while True:
        there, picture = video.read()
        if not there:
            return found
        found.append(picture)


def plan_of(count: int, given: argparse.Namespace) -> list[int]:
    """List which frame of the person each new frame shows, or `EMPTY` or `NOISE`."""
    plan = list(range(0, count, given.every))
    if given.away:
        first, end, away = map(int, given.away.split(":"))
        plan = [*plan[:first], *[EMPTY] * away, *plan[end:]]
    if given.noise:
        first, end = map(int, given.noise.split(":"))
        plan[first:end] = [NOISE] * (end - first)
    return plan


def make(trial: Path, folder: Path, plan: list[int], every: int) -> Path:
    """Write stills, plates, calibration, rate and truth of a made take."""
    rng = np.random.default_rng(0)
    skip = empty_frames(trial)
    with np.load(trial / "truth" / "truth.npz") as stored:
        truth = {name: stored[name] for name in stored.files if name != "vertices"}
    rate = float(truth["rate"]) / every
    (folder / "truth").mkdir(parents=True, exist_ok=True)
    shutil.copytree(trial / "background", folder / "background", dirs_exist_ok=True)
    shutil.copy(trial / "cameras.toml", folder)
    for name in tomllib.loads((trial / "cameras.toml").read_text()):
        if name == "metadata":
            continue
        clip, plate = pictures(trial / f"{name}.mp4"), cv2.imread(str(trial / "background" / f"{name}.png"))
        for i, frame in enumerate(plan):
            picture = clip[skip + frame] if frame >= 0 else plate + 3 * rng.normal(size=plate.shape)
            if frame == NOISE:
                picture = rng.integers(0, 255, plate.shape)
            cv2.imwrite(str(folder / f"{name}_{i:04d}.png"), np.clip(picture, 0, 255).astype(np.uint8))
    (folder / "trial.toml").write_text(f"rate = {rate}\n")
    for name in ("joints", "bone_rotation"):
        rows = np.full((len(plan), *truth[name].shape[1:]), np.nan)
        for i, frame in enumerate(plan):
            if frame >= 0:
                rows[i] = truth[name][frame]
        truth[name] = rows
    np.savez(folder / "truth" / "truth.npz", **truth | {"empty": np.array(0), "rate": np.array(rate)})
    return folder


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("take", nargs="?", help="a rendered take of data/people; all of CASES without one")
    parser.add_argument("--every", type=int, default=1, metavar="N")
    parser.add_argument("--away", default="", metavar="A:B:N")
    parser.add_argument("--noise", default="", metavar="A:B")


def run(run: Run) -> None:
    """Make, capture and score the takes."""
    given = run.arguments
    one = {"every": given.every, "away": given.away, "noise": given.noise}
    table = begin(run, "Harder takes", ("take", "made"), MOTION)
    states = []
    for take, changes in [(given.take, one)] if given.take else CASES:
        trial = run.shared / "data" / "people" / take
        made_as = argparse.Namespace(**{"every": 1, "away": "", "noise": ""} | changes)
        with np.load(trial / "truth" / "truth.npz") as truth:
            plan = plan_of(len(truth["joints"]), made_as)
        what = " ".join(f"--{name} {value}" for name, value in changes.items() if value not in ("", 1))
        folder = run.out / "made_takes" / f"{take}{what.replace(' ', '_').replace(':', '-')}"
        made = make(trial, folder / "trial", plan, made_as.every)
        out = capture(made, folder / "results")
        fill(table, (take, what), score(run, "capture.py", out, made / "truth" / "truth.npz"))
        states.append(f"`{take} {what}`: {runs(np.load(out / 'motion.npz')['state'])}")
    table.note += " `state` in `motion.npz`, with the number of frames: " + "; ".join(states) + "."


def runs(state: np.ndarray) -> str:
    """Runs of equal states, with their lengths."""
    ends = np.flatnonzero(np.diff(state)) + 1
    return ", ".join(f"{part[0]} ({len(part)})" for part in np.split(state, ends))
