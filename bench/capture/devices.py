"""Clocks of made devices against captured takes: gyroscopes, accelerometers, goniometers and a force plate.

The devices record the true motion on clocks of their own: a gyroscope of 200 Hz on each segment, whose axes are turned
at random; an accelerometer of 200 Hz at ankles, knees, elbows and wrists; a goniometer of 100 Hz at each knee and
elbow; and the vertical force of 1000 Hz under a person of 70 kg, whose parts have the masses of [deLeva1996] in the
middles between true joint centres. `marey device --within 0.4` estimates each clock from the captured motion, one
device at a time. An error is that of the instant which the clock gives in the middle, and at the worse end, of the
device's record.

`walk` and `clocks` repeat one recorded cycle, at whose ends the speeds of the joints jump by up to 3 m/s, so that they
have no accelerometers and no force plate.

The deviation that is added to that from the residuals (`repeated_sd_s`) is estimated from the errors in the middle by
maximum likelihood without the takes of one motion, whose errors are then compared with both.
"""

import argparse
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline
from scipy.stats import norm

from bench.capture.comparison import HINGES, flexion
from bench.common import program
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.errors import FileProblem
from marey.motion.device_clock import DEVICE_CLOCK_DEFAULTS, DeviceClock
from marey.motion.driving import GRAVITY
from marey.pipelines.device import align_device

BENCH = Bench(
    measures="Clocks of made gyroscopes, accelerometers, goniometers and force plates against captured takes.",
    sources=("src/marey/motion", "src/marey/pipelines/device.py", "src/marey/pipelines/capture", "src/marey/fit"),
    minutes=7,
)
MOTIONS = {"walk": "walk", "clocks": "walk", "reach": "reach", "jacks": "jacks", "stealth": "stealth"}
"""The takes, and their motions."""
JOINED, OF_SMOOTH_MOTION = ("walk", "clocks"), ("accelerometer", "force plate")
"""Takes whose speeds jump where a cycle is repeated, and devices that are not made of them."""
OFFSET_S, DRIFT = 0.137, 5e-5
"""The planted clock of the devices."""
WITHIN_S = 0.4
"""What is stated about the clocks: half of a step, or less."""
LIMBS = {
    "pelvis": "Hips", "thorax": "Spine1", "head": "Head", "thigh": "UpLeg", "shank": "Leg", "foot": "Foot",
    "upperarm": "Arm", "forearm": "ForeArm",
}  # fmt: skip
"""Our segments and the limbs of the rendered persons."""
SIDES = {"left_": ("Left", "l_"), "right_": ("Right", "r_")}
ACCELERATED = ("ankle", "knee", "elbow", "wrist")
TURNING_NOISE, TURNING_ZERO = 0.01, 0.02
"""Noise of a sample of a gyroscope, and the size of its error at rest [rad/s]: those of inexpensive sensors."""
ACCELERATION_NOISE = 0.05
"""Noise of a sample of an accelerometer [m/s2]."""
ANGLE_NOISE = np.radians(0.5)
"""Noise of a sample of a goniometer [rad]."""
FORCE_NOISE, MASS = 5.0, 70.0
"""Noise of a sample of the force [N], and the mass of the person [kg]."""
MASSES = (
    ("neck", "head", 0.068), ("pelvis", "neck", 0.430),
    *((f"{side}{upper}", f"{side}{lower}", share) for side in ("l_", "r_") for upper, lower, share in (
        ("shoulder", "elbow", 0.026), ("elbow", "wrist", 0.021), ("hip", "knee", 0.145), ("knee", "ankle", 0.046),
        ("ankle", "toe", 0.013),
    )),
)  # fmt: skip
"""Ends of the parts of the body and their shares of its mass, means of men and women ([deLeva1996], table 4); hands
belong to the forearms."""


@dataclass(frozen=True, eq=False)
class Truth:
    """The true motion of a take."""

    time: np.ndarray
    joints: Mapping[str, np.ndarray]
    rotation: Mapping[str, np.ndarray]

    @staticmethod
    def of(folder: Path) -> "Truth":
        """Read the truth of a rendered take."""
        with np.load(folder / "truth" / "truth.npz") as file:
            joints, turns = file["joints"], file["bone_rotation"].astype(float)
            time = (int(file["empty"]) + np.arange(len(joints))) / float(file["rate"])
            names, limbs = file["joint_names"].tolist(), file["limb_names"].tolist()
        paths = {name: joints[:, k] for k, name in enumerate(names)}
        return Truth(time, paths, {name: turns[:, k] for k, name in enumerate(limbs)})


@dataclass(frozen=True, eq=False)
class Device:
    """A made device: its samples at instants of the motion, and what they are matched with."""

    instants: np.ndarray
    values: Mapping[str, np.ndarray]
    match: str


def gyroscopes(truth: Truth, rng: np.random.Generator) -> Iterator[Device]:
    """A gyroscope on each segment."""
    for name, limb in LIMBS.items():
        for side, (long, _) in SIDES.items() if f"Left{limb}" in truth.rotation else {"": ("", "")}.items():
            spline = RotationSpline(truth.time, Rotation.from_matrix(truth.rotation[f"{long}{limb}"]))
            at = np.arange(truth.time[0], truth.time[-1], 1 / 200)
            # The spline's rates are in the axes of the segment.
            turned = spline(at, 1) @ Rotation.random(rng=rng).as_matrix()
            speed = turned + rng.normal(0, TURNING_ZERO, 3) + rng.normal(0, TURNING_NOISE, turned.shape)
            yield Device(at, dict(zip("xyz", speed.T, strict=True)), f"x,y,z=turning:{side}{name}")


def accelerometers(truth: Truth, rng: np.random.Generator) -> Iterator[Device]:
    """An accelerometer at joint centres."""
    at = np.arange(truth.time[0], truth.time[-1], 1 / 200)
    for side, (_, short) in SIDES.items():
        for joint in ACCELERATED:
            felt = CubicSpline(truth.time, truth.joints[f"{short}{joint}"])(at, 2) + [0.0, 0.0, GRAVITY]
            felt = felt + rng.normal(0, ACCELERATION_NOISE, felt.shape)
            yield Device(at, dict(zip("xyz", felt.T, strict=True)), f"x,y,z=acceleration:{side}{joint}")


def goniometers(truth: Truth, rng: np.random.Generator) -> Iterator[Device]:
    """A goniometer at each knee and elbow."""
    at = np.arange(truth.time[0], truth.time[-1], 1 / 100)
    for side, (_, short) in SIDES.items():
        for hinge, three in HINGES.items():
            bent = flexion(*(CubicSpline(truth.time, truth.joints[f"{short}{each}"])(at) for each in three))
            yield Device(at, {"bend": bent + rng.normal(0, ANGLE_NOISE, len(at))}, f"bend=angle:{side}{hinge}_flexion")


def plates(truth: Truth, rng: np.random.Generator) -> Iterator[Device]:
    """A force plate under both feet, all the time."""
    at = np.arange(truth.time[0], truth.time[-1], 1 / 1000)
    height = sum(share * (truth.joints[a] + truth.joints[b])[:, 2] / 2 for a, b, share in MASSES)
    force = MASS * (GRAVITY + CubicSpline(truth.time, height)(at, 2))
    yield Device(at, {"force": force + rng.normal(0, FORCE_NOISE, len(at))}, "force=force")


KINDS: dict[str, Callable[[Truth, np.random.Generator], Iterator[Device]]] = {
    "gyroscope": gyroscopes, "accelerometer": accelerometers, "goniometer": goniometers, "force plate": plates,
}  # fmt: skip


def estimated(device: Device, results: Path, folder: Path) -> DeviceClock | None:
    """Write the device's samples and estimate its clock; None where `marey device` gives no answer."""
    own = (device.instants - OFFSET_S) / (1 + DRIFT)
    path = folder / "device.csv"
    table = np.column_stack([own, *device.values.values()])
    np.savetxt(path, table, "%.9f", ",", header=",".join(["time", *device.values]), comments="")
    try:
        return align_device(results, path, match=[device.match], within=WITHIN_S).clock
    except FileProblem:
        return None


def judged(device: Device, clock: DeviceClock) -> np.ndarray:
    """Errors and standard deviations [ms] in the middle and at the worse end."""
    own = (device.instants - OFFSET_S) / (1 + DRIFT)
    at = np.array([own[len(own) // 2], own[0], own[-1]])
    off = 1e3 * (clock.instants(at) - (OFFSET_S + (1 + DRIFT) * at))
    sd, end = 1e3 * clock.instants_sd(at), 1 + int(np.argmax(np.abs(off[1:])))
    return np.array([off[0], sd[0], off[end], sd[end]])


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("takes", nargs="*", help=f"rendered takes of data/people; {', '.join(MOTIONS)} without any")


def run(run: Run) -> None:
    """Estimate the clocks of all devices."""
    table = run.table(
        "Clocks of single devices", ("take", "device"), Column("clocks determined"), Column("middle, median", "ms", 2),
        Column("worst", "ms", 2), Column("stated sd, median", "ms", 2), Column("end, median", "ms", 2),
        Column("worst", "ms", 2), Column("stated sd, median", "ms", 2), Column("held by 95 % intervals", "%", 0),
    )  # fmt: skip
    folder = run.out / "devices"
    middles: dict[str, list[np.ndarray]] = {}
    folder.mkdir(parents=True, exist_ok=True)
    for take in run.arguments.takes or MOTIONS:
        trial, results = program.take(run, take)
        truth = Truth.of(trial)
        for kind, make in KINDS.items():
            if take in JOINED and kind in OF_SMOOTH_MOTION:
                continue
            devices = list(make(truth, np.random.default_rng(0)))
            clocks = [(each, estimated(each, results, folder)) for each in devices]
            known = np.array([judged(each, clock) for each, clock in clocks if clock is not None]).reshape(-1, 4)
            table.row((take, kind), f"{len(known)} of {len(devices)}", *summary(known))
            if kind != "force plate":
                middles.setdefault(MOTIONS.get(take, take), []).append(known[:, :2])
    if len(middles) > 1:
        table_of_addition(run, {motion: np.concatenate(parts) for motion, parts in middles.items()})


def summary(known: np.ndarray) -> list[float | None]:
    """The cells of a row from errors and deviations (n, 4) in the middle and at the end."""
    if not len(known):
        return [None] * 7
    found = np.abs(known)
    held = 100 * np.mean(found[:, ::2] < 1.96 * found[:, 1::2])
    return [x for k in (0, 2) for x in (np.median(found[:, k]), found[:, k].max(), np.median(found[:, k + 1]))] + [held]


def table_of_addition(run: Run, middles: Mapping[str, np.ndarray]) -> None:
    """Estimate the added deviation without each motion, and apply it to that motion."""
    table = run.table(
        "Added standard deviation", "held-out motion", Column("errors"), Column("from the others", "ms", 2),
        Column("held by 50 %", "", 2), Column("80 %", "", 2), Column("95 %", "", 2),
        Column("by the residuals alone, 95 %", "", 2),
    )  # fmt: skip
    limits, every = norm.ppf([0.75, 0.9, 0.975]), []
    for motion, own in middles.items():
        others = np.concatenate([found for name, found in middles.items() if name != motion])
        added, residual = most_probable(others[:, 0], of_residuals(others[:, 1])), of_residuals(own[:, 1])
        off = np.abs(own[:, :1]) / np.column_stack([np.hypot(residual, added), residual])
        every.append(off)
        table.row(motion, len(own), added, *(off[:, :1] < limits).mean(axis=0), np.mean(off[:, 1] < limits[-1]))
    off = np.concatenate(every)
    table.row("all", len(off), None, *(off[:, :1] < limits).mean(axis=0), np.mean(off[:, 1] < limits[-1]))


def of_residuals(sd: np.ndarray) -> np.ndarray:
    """The part of standard deviations [ms] that comes from the residuals."""
    return np.sqrt(np.maximum(sd**2 - (1e3 * DEVICE_CLOCK_DEFAULTS.repeated_sd_s) ** 2, 1e-6))


def most_probable(error: np.ndarray, sd: np.ndarray) -> float:
    """The added deviation [ms] that makes the errors most probable."""
    tried = np.arange(0.0, 10.0, 0.01)
    variance = sd**2 + tried[:, None] ** 2
    return float(tried[np.argmin((np.log(variance) + error**2 / variance).sum(axis=1))])
