"""Captured motion: joint centres, flexions and lengths of limbs in short spans of rendered takes, good and bad ones.

Each span, and a single frame of it alone, is captured with all cameras, and with two or three. Joint centres are
compared as they are, with the expected constant offset of each joint in their standard deviations, and without each
joint's constant offset in the frame of its limb. Flexions are those between joint centres, without a constant
difference.
"""

import sys
import tomllib
from collections.abc import Iterator

import numpy as np

from bench.capture.takes import LENGTHS
from bench.common.program import capture, empty_frames, truth_of
from bench.intervals.scoring import Sample, sample, single
from bench.recording import Run
from marey.errors import MareyError

SPANS = {"walk": (20, 50), "reach": (55, 85), "jacks": (40, 70), "stealth": (80, 110)}
"""First frame of each span, and the frame after its last, counted from the first that shows a person."""
FEWER = {"walk": ((0, 1),), "reach": ((1, 3),), "jacks": ((0, 1),), "stealth": ((0, 1, 2), (0, 1))}
"""Cameras of the captures of each take with fewer than all."""
SINGLE = (15, 5)
"""Frames of each span that are captured alone with these; the first of them also with all cameras."""
SEGMENTS = {"shoulder": "upperarm", "elbow": "forearm", "wrist": "hand", "hip": "thigh", "knee": "shank",
            "ankle": "foot"}  # fmt: skip
"""Segment that begins at each joint."""
JOINTS = tuple(f"{side}_{joint}" for side in ("left", "right") for joint in SEGMENTS)
FLEXIONS = {"knee": ("hip", "knee", "ankle"), "elbow": ("shoulder", "elbow", "wrist")}
"""Joints between which a flexion is measured."""
ALL_KINDS = "joint centres, all these captures"
"""Quantity of the joint centres of good and bad captures together, in which failures are looked for."""
IN_TIME = ("joint_centres", "joint_centres_sd", "angles_deg", "angles_deg_sd")
"""What `motion.npz` holds for each frame of the video, as far as it is compared."""


def samples(run: Run) -> Iterator[Sample]:
    """Capture all spans in all ways, and compare."""
    for name, (first, end) in SPANS.items():
        trial = run.shared / "data" / "people" / name
        names = [each for each in tomllib.loads((trial / "cameras.toml").read_text()) if each != "metadata"]
        for kept in (tuple(range(len(names))), *FEWER[name]):
            cameras, fewer = [names[k] for k in kept], len(kept) < len(names)
            yield from of_capture(run, name, cameras, "fewer cameras" if fewer else "all cameras", first, end)
            for frame in SINGLE if fewer else SINGLE[:1]:
                yield from of_capture(run, name, cameras, "single frames", first + frame, first + frame + 1)


def of_capture(run: Run, name: str, cameras: list[str], kind: str, first: int, end: int) -> Iterator[Sample]:
    """Capture frames of a take with some cameras, and compare them with the truth."""
    trial = run.shared / "data" / "people" / name
    empty, alone = empty_frames(trial), end - first == 1
    out = run.out / "intervals" / "motion" / f"{name}_{''.join(each[-1] for each in cameras)}_{first}_{end}"
    try:
        capture(trial, out, frames=range(first + empty, end + empty), cameras=cameras)
    except MareyError as problem:
        run.report(f"{out.name}: {problem}")
        return
    with np.load(truth_of(trial)) as file:
        truth = {key: file[key][first:end] if file[key].ndim > 1 else file[key] for key in file.files}
    with np.load(out / "motion.npz") as file:
        motion = {key: file[key] for key in file.files}
    motion |= {key: motion[key][first + empty : end + empty] for key in IN_TIME}
    case = f"{name}, {len(cameras)} cameras"
    with np.load(out / "body.npz") as file:
        body = {key: file[key] for key in file.files}
    yield from of_joints(run, kind, case, motion, body, truth, alone=alone)
    if not alone:
        yield from of_flexions(kind, case, motion, truth)
        yield of_lengths(case, body, truth)


def of_joints(
    run: Run, kind: str, case: str, motion: dict, body: dict, truth: dict, *, alone: bool
) -> Iterator[Sample]:
    """Compare the centres of the limbs' joints."""
    own = [[str(each) for each in motion["joint_names"]].index(joint) for joint in JOINTS]
    error = 1e3 * (motion["joint_centres"][:, own] - true_joints(truth, JOINTS))
    sd = 1e3 * motion["joint_centres_sd"][:, own]
    segments = [str(each) for each in body["segment_names"]]
    starts = [segments.index(f"{joint.partition('_')[0]}_{SEGMENTS[joint.partition('_')[2]]}") for joint in JOINTS]
    whole = np.sqrt(sd**2 + (1e3 * body["segment_origin_offset_sd"][starts, None]) ** 2)
    yield sample(f"joint centres, {kind}", case, "mm", error, whole)
    yield sample(ALL_KINDS, case, "mm", error, whole)
    if not alone:
        sys.path.insert(0, str(run.shared / "score"))
        from capture import less_own_offset

        steady = less_own_offset(error, list(JOINTS), truth)
        yield sample(f"joint centres without constant offset, {kind}", case, "mm", steady, sd)


def of_flexions(kind: str, case: str, motion: dict, truth: dict) -> Iterator[Sample]:
    """Compare the flexions of knees and elbows, without a constant difference."""
    names = [str(each) for each in motion["angle_names"]]
    for side in ("left", "right"):
        for joint, three in FLEXIONS.items():
            k = names.index(f"{side}_{joint}_flexion")
            bend = flexion(true_joints(truth, [f"{side}_{each}" for each in three]))
            error = motion["angles_deg"][:, k] - bend
            error = error - np.nanmean(error)
            label = f"{case}, {side} {joint}"
            yield single(
                f"flexions without constant offset, {kind}", label, "deg", error, motion["angles_deg_sd"][:, k]
            )


def of_lengths(case: str, body: dict, truth: dict) -> Sample:
    """Compare the lengths of thighs, shanks, upper arms and forearms."""
    segments = [str(each) for each in body["segment_names"]]
    error, sd = [], []
    for segment, (upper, lower) in LENGTHS.items():
        for side in ("left", "right"):
            ends = true_joints(truth, [f"{side}_{upper}", f"{side}_{lower}"])
            true = np.median(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1))
            k = segments.index(f"{side}_{segment}")
            error.append(1e3 * (body["segment_length"][k] - true))
            sd.append(1e3 * body["segment_length_sd"][k])
    return single("lengths of limbs", case, "mm", np.array(error), np.array(sd))


def true_joints(truth: dict, joints: list[str] | tuple[str, ...]) -> np.ndarray:
    """The true centres (F, J, 3) of joints [m]."""
    names = [str(each) for each in truth["joint_names"]]
    return truth["joints"][:, [names.index(f"{joint[0]}_{joint.partition('_')[2]}") for joint in joints]]


def flexion(points: np.ndarray) -> np.ndarray:
    """The angle (F,) by which three points (F, 3, 3) depart from a line [deg]."""
    first, second = points[:, 1] - points[:, 0], points[:, 2] - points[:, 1]
    cosine = np.sum(first * second, axis=1) / np.linalg.norm(first, axis=1) / np.linalg.norm(second, axis=1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))
