"""Captured takes against their truth: joints, angles, silhouettes and surface.

Without options every take is captured with all cameras and scored. `--drop-cameras` leaves out each camera in turn,
`--upper` captures the arms of `reach` from images cut at the hips, `--starts` captures every tenth frame alone, and
`--backwards` captures the takes backwards and without their empty frames, so that the empty room is known from its
images alone and every capture starts from other frames. The takes `walk`, `reach`, `stealth` and `jacks` are rendered,
with exact truth; `balancing` is real, and its reference are key points that a detector found, with errors of some
centimetres.
"""

import argparse
import tomllib
from pathlib import Path

import cv2
import numpy as np

from bench.common.program import capture, empty_frames, score, truth_of
from bench.common.sabotaged_takes import TakeCopy
from bench.declaration import Bench
from bench.recording import Column, Run, Table

BENCH = Bench(
    measures=(
        "Joints, angles, silhouettes and surface of captured takes, against rendered truth or detected key points."
    ),
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
    minutes=6,
)

TAKES = ("walk", "reach", "stealth", "jacks", "balancing")
LEGS = "pelvis|thorax|head|thigh|shank|foot"
ARMS = "shoulder|elbow|wrist"
CUT_ROW = 285
"""First row (pixels) that is cut away from the images of `reach`."""

MOTION = (
    (Column("joints", "mm", 1), "joint_mm"),
    (Column("worst joint, 95 %", "mm", 0), "joint_p95_mm"),
    (Column("steady", "mm", 1), "steady_mm"),
    (Column("elbow, knee", "deg", 1), "elbow_knee_deg"),
    (Column("steady", "deg", 1), "elbow_knee_steady_deg"),
    (Column("95 % intervals hold", "", 2), "covered_95"),
    (Column("in the limb's frame", "", 2), "own_covered_95"),
    (Column("frames with a result", "", 3), "seen"),
)
"""Columns of a motion, with the names that score/capture.py gives."""
WHOLE = (
    *MOTION,
    (Column("trunk, legs turn", "deg", 1), "turn_trunk_legs_deg"),
    (Column("silhouettes IoU", "", 3), "iou_masks"),
    (Column("surface IoU", "", 3), "iou_surface_masks"),
    (Column("worst length", "mm", 1), "lengths_worst_mm"),
    (Column("lengths, stated sd", "", 2), "lengths_in_sd"),
    (Column("agreement by camera"), "agreement"),
)
NOTE = (
    "*Joints*: mean distance of the twelve limb joint centres from the truth; *steady*: the same without each joint's "
    "constant offset. *In the limb's frame*: share of the intervals that hold without each joint's constant offset in "
    "the frame of its limb, which they do not include. *Turn*: rotation of the segment since its first frame, against "
    "the truth. *Lengths*: thighs, shanks, upper arms and forearms; their root mean square error in stated standard "
    "deviations. *Agreement*: overlap of the fitted surface and the silhouettes."
)

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


def judged(run: Run, trial: Path, out: Path) -> dict:
    """Score motion, silhouettes and surface of a take."""
    skip = ("--skip-empty", empty_frames(trial))
    numbers = score(run, "capture.py", out, truth_of(trial), *skip)
    numbers["turn_trunk_legs_deg"] = score(run, "capture.py", out, truth_of(trial), *skip, "--limbs", LEGS).get(
        "turn_deg"
    )
    masks = trial / "truth" / "masks.npz"
    masks = masks if masks.exists() else trial / "truth" / "masks"
    for kind in ("masks", "surface_masks"):
        numbers[f"iou_{kind}"] = score(run, "masks.py", out, masks, *skip, "--of", kind)["iou"]
    numbers |= lengths(trial, out)
    if truth_of(trial).name != "truth.npz":  # Key points have errors of their own, which the intervals do not include.
        numbers.pop("covered_95", None)
        numbers.pop("own_covered_95", None)
    agreement = np.load(out / "motion.npz")["agreement"]
    numbers["agreement"] = " ".join(f"{v:.2f}" for v in np.nanmean(agreement, 0))
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


def starts(run: Run, trial: Path) -> tuple[int, int, int]:
    """Start from every tenth frame alone: the starts, those facing right, those within 150 mm."""
    truth = np.load(truth_of(trial))
    skip = empty_frames(trial)
    count = len(truth["joints"] if "joints" in truth else truth["xyz"])
    worst, facing = [], []
    for frame in range(skip, skip + count, 10):
        where = run.out / "starts" / trial.name / f"frame_{frame:04d}"
        capture(trial, where, frames=range(frame, frame + 1))
        errors, forward = start_errors(where, truth, frame, frame - skip)
        worst.append(errors.max())
        facing.append(forward > 0)
    return len(worst), int(np.sum(facing)), int(np.sum(np.array(worst) < 0.15))


def start_errors(out: Path, truth: "np.lib.npyio.NpzFile", frame: int, row: int) -> tuple[np.ndarray, float]:
    """The limb joints' errors [m] of one frame, and the cosine between the hips' line and the true one."""
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


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("takes", nargs="*", help=f"of {', '.join(TAKES)}, or another folder of data/people")
    parser.add_argument("--drop-cameras", action="store_true", help="leave out each camera in turn")
    parser.add_argument("--upper", action="store_true", help="the arms of reach, from pictures cut at the hips")
    parser.add_argument("--starts", action="store_true", help="capture every tenth frame alone")
    parser.add_argument("--backwards", action="store_true", help="from the last frame to the first that shows somebody")


def run(run: Run) -> None:
    """Capture and score."""
    given = run.arguments
    trials = [run.shared / "data" / "people" / name for name in given.takes or ([] if given.upper else TAKES)]
    if given.starts:
        every_start(run, trials)
    elif given.backwards:
        backwards(run, [trial for trial in trials if (trial / "truth" / "truth.npz").exists()])
    elif given.drop_cameras:
        without_cameras(run, trials)
    elif trials:
        whole(run, trials)
    if given.upper:
        upper_body(run)


def begin(run: Run, title: str, labels: str | tuple[str, ...], columns: tuple = MOTION) -> Table:
    """Begin a table of scores."""
    return run.table(title, labels, *(column for column, _ in columns), note=NOTE)


def fill(table: Table, labels: str | tuple[str, ...], numbers: dict, columns: tuple = MOTION) -> None:
    """Append the scores of one capture."""
    table.row(labels, *(numbers.get(key) for _, key in columns))


def whole(run: Run, trials: list[Path]) -> None:
    """Capture with all cameras."""
    table = begin(run, "All cameras", "take", WHOLE)
    for trial in trials:
        out = capture(trial, run.out / "takes" / trial.name)
        fill(table, trial.name, judged(run, trial, out), WHOLE)


def without_cameras(run: Run, trials: list[Path]) -> None:
    """Capture with each camera left out in turn."""
    table = begin(run, "One camera left out", ("take", "without"))
    for trial in trials:
        cameras = [name for name in tomllib.loads((trial / "cameras.toml").read_text()) if name != "metadata"]
        for camera in cameras:
            kept = [name for name in cameras if name != camera]
            out = capture(trial, run.out / "takes" / f"{trial.name}_without_{camera}", cameras=kept)
            skip = ("--skip-empty", empty_frames(trial))
            fill(table, (trial.name, camera), score(run, "capture.py", out, truth_of(trial), *skip))


def backwards(run: Run, trials: list[Path]) -> None:
    """Capture the takes from their last frame to the first one that shows the person."""
    table = begin(run, "Backwards, without empty frames", "take")
    for trial in trials:
        copy, empty = TakeCopy.of(trial, run.out / "backwards" / trial.name), empty_frames(trial)
        for number in range(len(copy.names)):
            copy.film(number, lambda images, first=empty: images[first:][::-1], plate=False)
        truth = dict(np.load(truth_of(trial)))
        reversed_truth = {name: truth[name][::-1] for name in ("joints", "bone_rotation")}
        np.savez(copy.folder / "truth.npz", **truth | reversed_truth)
        out = capture(copy.folder, run.out / "takes" / f"{trial.name}_backwards")
        fill(table, trial.name, score(run, "capture.py", out, copy.folder / "truth.npz"))


def every_start(run: Run, trials: list[Path]) -> None:
    """Start from every tenth frame alone."""
    columns = (Column("starts"), Column("facing right"), Column("every limb joint within 150 mm"))
    table = run.table("Starts from every tenth frame alone", "take", *columns)
    for trial in trials:
        table.row(trial.name, *starts(run, trial))


def upper_body(run: Run) -> None:
    """Capture the arms of `reach` from images that end at the hips."""
    trial = run.shared / "data" / "people" / "reach"
    cut = cut_at_hips(trial, run.out / "reach_cut")
    out = capture(cut, run.out / "takes" / "reach_upper", preset="upper")
    arms = ("--skip-empty", empty_frames(trial), "--joints", ARMS)
    fill(
        begin(run, "Cut at the hips, `--preset upper`, arms alone", "take"),
        "reach",
        score(run, "capture.py", out, truth_of(trial), *arms),
    )
