"""Make harder takes of a rendered one, capture and score them: frames left out, somebody who leaves, pictures of noise.

    python bench/made_takes.py SHARED OUT jacks --every 6
    python bench/made_takes.py SHARED OUT walk --away 35:64:25
    python bench/made_takes.py SHARED OUT walk --noise 40:55

--every N keeps each N-th frame, as a slower camera would. --away A:B:N shows the empty room for N frames in the place
of frames A to B, so that the person comes back elsewhere. --noise A:B shows nothing but noise in frames A to B. Frames
count from the first that shows somebody. The truth of the frames that are left is scored; results stay in OUT.
"""

import argparse
import json
import shutil
import tomllib
from pathlib import Path

import cv2
import numpy as np

from takes import capture, empty_frames, score

EMPTY, NOISE = -1, -2


def pictures(clip: Path) -> list[np.ndarray]:
    """Read a clip."""
    video, found = cv2.VideoCapture(str(clip)), []
    while True:
        there, picture = video.read()
        if not there:
            return found
        found.append(picture)


def plan_of(count: int, asked: argparse.Namespace) -> list[int]:
    """List which frame of the person each new frame shows, or `EMPTY` or `NOISE`."""
    plan = list(range(0, count, asked.every))
    if asked.away:
        first, end, away = map(int, asked.away.split(":"))
        plan = [*plan[:first], *[EMPTY] * away, *plan[end:]]
    if asked.noise:
        first, end = map(int, asked.noise.split(":"))
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


def main() -> None:
    """Make, capture and score one take."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shared", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("take")
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--away", default="")
    parser.add_argument("--noise", default="")
    asked = parser.parse_args()
    trial = asked.shared / "data" / "people" / asked.take
    with np.load(trial / "truth" / "truth.npz") as truth:
        plan = plan_of(len(truth["joints"]), asked)
    name = f"{asked.take}_{asked.every}_{asked.away}_{asked.noise}".replace(":", "-").strip("_")
    made, out = make(trial, asked.out / "made" / name, plan, asked.every), asked.out / name
    capture(made, out)
    numbers = score(asked.shared / "score" / "capture.py", out, made / "truth" / "truth.npz")
    state = "".join(map(str, np.load(out / "motion.npz")["state"]))
    print(json.dumps({"take": name, **numbers, "state": state}), flush=True)


if __name__ == "__main__":
    main()
