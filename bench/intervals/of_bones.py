"""Bones from skin markers: rotations and positions of thigh and shank in real trials with true bones."""

from collections.abc import Iterator

import numpy as np

from bench.intervals.scoring import Sample, sample
from bench.markers.made_skin_trials import KINDS, made_trial
from bench.markers.trials import read_trial
from bench.recording import Run
from marey.geometry import rotations
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.methods.methods import METHODS

TRIALS = (
    "lmam_treadmill_walking", "ottawa_walking", "unibo_step_up", "csuohio_running", "foroit_hip_knee_flexion",
    "ntu_walking",
)  # fmt: skip
COMPARED = ("skin", "global", "rigid", "pct")
"""Methods on the real trials: the default, then others."""
MADE = 3
"""Made trials of each kind of activity, for the default method."""
POSTURES = ("one posture", "two postures")


def samples(run: Run) -> Iterator[Sample]:
    """Estimate bones of real trials by several methods, and of made ones by the default."""
    folder = run.shared / "data" / "markers" / "sta"
    for method in COMPARED:
        for name in TRIALS:
            with np.load(folder / f"{name}.npz") as file:
                segments = [str(each) for each in file["segments"]]
                truth = {s: (file[f"{s}_rotation"], file[f"{s}_origin"] / 1000) for s in segments}
            for postures, problem in zip(POSTURES, read_trial(folder, name), strict=True):
                yield from of_bones(f"`{method}`, {postures}", name, METHODS[method].run(problem), truth)
    for kind, each in KINDS.items():
        rng = np.random.default_rng(0)
        for number in range(MADE):
            trial = made_trial(rng, each)
            for count, postures in enumerate(POSTURES, 1):
                motion = METHODS["skin"].run(trial.problem(count))
                yield from of_bones(f"made trials, `skin`, {postures}", f"{kind} {number}", motion, trial.bones)


def of_bones(
    what: str, case: str, motion: BoneMotion, truth: dict[str, tuple[np.ndarray, np.ndarray]]
) -> Iterator[Sample]:
    """Compare bones with the truth: rotations (F, 3, 3) and origins (F, 3) [m] by segment."""
    for index, name in enumerate(motion.segments):
        rotation, origin = truth[name]
        turn = rotations.log(np.swapaxes(motion.rotation[:, index], 1, 2) @ rotation)
        yield sample(
            f"rotations, {what}", case, "deg", np.degrees(turn), np.degrees(motion.rotation_sd[:, index])
        )  # fmt: skip
        off = 1000 * (motion.origin[:, index] - origin)
        yield sample(f"positions, {what}", case, "mm", off, 1000 * motion.origin_sd[:, index])
