"""Capture takes whose truth is known, and score them: the table of docs/accuracy.md.

    python bench/takes.py SHARED OUT [walk reach ...] [--drop-cameras] [--upper] [--starts]

SHARED holds `data/people` and `score`. --drop-cameras takes every camera away in turn; --upper cuts the pictures of
reach at the hips; --starts captures every tenth frame alone. Results stay in OUT; a finished one is not made again.
"""

import argparse
import json
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import numpy as np

LEGS = "pelvis|thorax|head|thigh|shank|foot"
ARMS = "shoulder|elbow|wrist"
CUT_ROW = 285


def capture(trial: Path, out: Path, *options: str) -> None:
    """Run `marey capture` unless its results are there."""
    if not (out / "run.json").exists():
        command = [sys.executable, "-c", "from marey.cli.main import main; main()", "capture", str(trial)]
        subprocess.run([*command, "--out", str(out), "--no-overlay", "--quiet", *options], check=True)


def score(script: Path, *arguments: object) -> dict:
    """Run a score script; give the numbers of its last line."""
    run = subprocess.run(
        [sys.executable, str(script), *map(str, arguments)], capture_output=True, text=True, check=True
    )
    return json.loads(run.stdout.splitlines()[-1])


def empty_frames(trial: Path) -> int:
    """Tell how many leading frames of a take show nobody."""
    truth = trial / "truth" / "truth.npz"
    return int(np.load(truth)["empty"]) if truth.exists() else 0


def truth_of(trial: Path) -> Path:
    """Find what is known of a take: rendered joints, or detected key points."""
    rendered = trial / "truth" / "truth.npz"
    return rendered if rendered.exists() else trial / "truth" / "keypoints3d.npz"


LENGTHS = {
    "thigh": ("hip", "knee"),
    "shank": ("knee", "ankle"),
    "upperarm": ("shoulder", "elbow"),
    "forearm": ("elbow", "wrist"),
}


def lengths(trial: Path, out: Path) -> dict:
    """Compare the limbs' lengths with the truth: worst error, and root mean square in standard deviations."""
    if not truth_of(trial).name.startswith("truth"):
        return {}
    truth, body = np.load(truth_of(trial)), np.load(out / "body.npz")
    joints = {str(n): truth["joints"][:, k] for k, n in enumerate(truth["joint_names"])}
    own = {str(n): k for k, n in enumerate(body["segment_names"])}
    errors, shares = [], []
    for side in ("left", "right"):
        for segment, (upper, lower) in LENGTHS.items():
            k = own[f"{side}_{segment}"]
            true = np.median(np.linalg.norm(joints[f"{side[0]}_{upper}"] - joints[f"{side[0]}_{lower}"], axis=1))
            errors.append(body["segment_length"][k] - true)
            shares.append(errors[-1] / body["segment_length_sd"][k])
    return {
        "lengths_worst_mm": round(1e3 * float(np.abs(errors).max()), 1),
        "lengths_in_sd": round(float(np.sqrt(np.mean(np.square(shares)))), 2),
    }


def judged(shared: Path, trial: Path, out: Path) -> dict:
    """Score motion, silhouettes and surface of a take."""
    skip = ("--skip-empty", empty_frames(trial))
    numbers = score(shared / "score" / "capture.py", out, truth_of(trial), *skip)
    numbers["turn_trunk_legs_deg"] = score(
        shared / "score" / "capture.py", out, truth_of(trial), *skip, "--limbs", LEGS
    ).get("turn_deg")
    masks = trial / "truth" / "masks.npz"
    masks = masks if masks.exists() else trial / "truth" / "masks"
    for kind in ("masks", "surface_masks"):
        numbers[f"iou_{kind}"] = score(shared / "score" / "masks.py", out, masks, *skip, "--of", kind)["iou"]
    numbers |= lengths(trial, out)
    agreement = np.load(out / "motion.npz")["agreement"]
    numbers["agreement"] = [round(float(v), 3) for v in np.nanmean(agreement, 0)]
    numbers["timings_s"] = json.loads((out / "run.json").read_text())["timings_s"]
    return numbers


def cut_at_hips(trial: Path, folder: Path) -> Path:
    """Copy a trial with the rows from `CUT_ROW` on taken away; of the calibration only `size` changes."""
    (folder / "background").mkdir(parents=True, exist_ok=True)
    text = (trial / "cameras.toml").read_text()
    (folder / "cameras.toml").write_text(text.replace("size = [ 640.0, 480.0]", f"size = [ 640.0, {CUT_ROW}.0]"))
    for name in tomllib.loads(text):
        if name == "metadata":
            continue
        plate = cv2.imread(str(trial / "background" / f"{name}.png"))
        cv2.imwrite(str(folder / "background" / f"{name}.png"), plate[:CUT_ROW])
        clip, number = cv2.VideoCapture(str(trial / f"{name}.mp4")), 0
        while True:
            there, picture = clip.read()
            if not there:
                break
            cv2.imwrite(str(folder / f"{name}_{number:04d}.png"), picture[:CUT_ROW])
            number += 1
    (folder / "trial.toml").write_text("rate = 30.0\n")
    return folder


def starts(shared: Path, trial: Path, out: Path) -> dict:
    """Start from every tenth frame alone; tell the share of starts whose limb joints all lie within 150 mm."""
    truth = np.load(truth_of(trial))
    skip = empty_frames(trial)
    count = len(truth["joints"] if "joints" in truth else truth["xyz"])
    worst, facing = [], []
    for frame in range(skip, skip + count, 10):
        where = out / f"frame_{frame:04d}"
        capture(trial, where, "--frames", f"{frame}:{frame + 1}")
        errors, forward = start_errors(where, truth, frame, frame - skip)
        worst.append(errors.max())
        facing.append(forward > 0)
    return {
        "starts": len(worst),
        "within_150_mm": float(np.mean(np.array(worst) < 0.15)),
        "facing": float(np.mean(facing)),
    }


def start_errors(out: Path, truth: "np.lib.npyio.NpzFile", frame: int, row: int) -> tuple[np.ndarray, float]:
    """Give the limb joints' errors [m] of one frame, and the cosine between the hips' line and the true one."""
    motion = np.load(out / "motion.npz")
    own = dict(zip(motion["joint_names"], motion["joint_centres"][frame], strict=True))
    if "joints" in truth:
        long = {"l_": "left_", "r_": "right_"}
        names = [long.get(n[:2], n[:2]) + n[2:] for n in map(str, truth["joint_names"])]
        true = dict(zip(names, truth["joints"][row], strict=True))
    else:
        names = [("left_" if n[0] == "L" else "right_") + n[1:].lower() for n in map(str, truth["names"])]
        true = dict(zip(names, truth["xyz"][row], strict=True))
    limbs = [f"{s}_{j}" for s in ("left", "right") for j in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")]
    errors = np.array([np.linalg.norm(own[name] - true[name]) for name in limbs])
    return np.nan_to_num(errors, nan=np.inf), float(
        (own["left_hip"] - own["right_hip"]) @ (true["left_hip"] - true["right_hip"])
    )


def main() -> None:
    """Capture and score what was asked for; print one JSON line a take."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shared", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("takes", nargs="*")
    parser.add_argument("--drop-cameras", action="store_true")
    parser.add_argument("--upper", action="store_true")
    parser.add_argument("--starts", action="store_true")
    asked = parser.parse_args()
    for name in asked.takes:
        trial, out = asked.shared / "data" / "people" / name, asked.out / name
        if asked.starts:
            print(json.dumps({"take": name, **starts(asked.shared, trial, asked.out / "starts" / name)}), flush=True)
            continue
        cameras = [c for c in tomllib.loads((trial / "cameras.toml").read_text()) if c != "metadata"]
        if asked.drop_cameras:
            for left_out in cameras:
                kept = [c for c in cameras if c != left_out]
                capture(trial, asked.out / f"{name}_without_{left_out}", "--cameras", ",".join(kept))
                numbers = score(
                    asked.shared / "score" / "capture.py", asked.out / f"{name}_without_{left_out}", truth_of(trial),
                    "--skip-empty", empty_frames(trial),
                )  # fmt: skip
                print(json.dumps({"take": name, "without": left_out, **numbers}), flush=True)
            continue
        capture(trial, out)
        print(json.dumps({"take": name, **judged(asked.shared, trial, out)}), flush=True)
    if asked.upper:
        trial = asked.shared / "data" / "people" / "reach"
        cut = cut_at_hips(trial, asked.out / "reach_cut")
        capture(cut, asked.out / "reach_upper", "--preset", "upper")
        arms = ("--skip-empty", empty_frames(trial), "--joints", ARMS)
        numbers = score(asked.shared / "score" / "capture.py", asked.out / "reach_upper", truth_of(trial), *arms)
        print(json.dumps({"take": "reach cut at the hips", **numbers}), flush=True)


if __name__ == "__main__":
    main()
