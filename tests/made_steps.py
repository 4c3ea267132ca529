"""A made walker: heels, toes and body with known instants of strike and off, over ground, on a belt or in a turn."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.motion.events.feet import FootPath, WalkPaths

CYCLE_S, STRIDE_M, WIDTH_M, FOOT_M = 1.1, 1.32, 0.12, 0.2
"""Cycle of each foot, its stride, the distance between the lines of the feet, and the length of a foot."""
OFF_SHARE = 0.62
"""Phase of a foot at which it leaves the floor."""


@dataclass(frozen=True, kw_only=True)
class Steps:
    """How the feet move."""

    cycle_s: float = CYCLE_S
    stride_m: float = STRIDE_M
    flat: float = 0.08
    """Phase at which the toe is down."""
    rise: float = 0.40
    """Phase at which the heel rises."""
    off: float = OFF_SHARE
    """Phase at which the foot leaves the floor."""


WALK = Steps()
SLOW = Steps(cycle_s=1.6, stride_m=0.7, rise=0.5, off=0.7)
RUN = Steps(cycle_s=0.72, stride_m=2.4, flat=0.05, rise=0.2, off=0.36)
FAST_RUN = Steps(cycle_s=0.66, stride_m=3.2, flat=0.03, rise=0.14, off=0.28)


def hermite(share: Floats, start: float, end: float, slope: float, end_slope: float) -> Floats:
    s = share
    return (
        (2 * s**3 - 3 * s**2 + 1) * start + (s**3 - 2 * s**2 + s) * slope
        + (-2 * s**3 + 3 * s**2) * end + (s**3 - s**2) * end_slope
    )  # fmt: skip


def foot_at(time: Floats, delay: float, steps: Steps) -> tuple[Floats, Floats]:
    """Heel and toe (F, 3) of a foot that strikes at `delay` + k cycles, walking along x."""
    count, phase = np.divmod((time - delay) / steps.cycle_s, 1.0)
    swing_s = (1 - steps.off) * steps.cycle_s
    lift, down = np.radians(-60.0), np.radians(20.0)
    rise = np.clip((phase - steps.rise) / (steps.off - steps.rise), 0, 1)
    s = np.clip((phase - steps.off) / (1 - steps.off), 0, 1)
    rate = 2 * lift / ((steps.off - steps.rise) * steps.cycle_s)
    swinging = phase > steps.off
    pitch = np.where(phase < steps.flat, down * (1 - phase / steps.flat), lift * rise**2)
    pitch = np.where(swinging, hermite(s, lift, down, rate * swing_s, 0.0), pitch)
    left_at = FOOT_M * np.array([1 - np.cos(lift), -np.sin(lift)])  # the heel when the foot leaves the floor
    left_with = rate * FOOT_M * np.array([np.sin(lift), -np.cos(lift)]) * swing_s
    along = np.where(phase < steps.rise, 0.0, FOOT_M * (1 - np.cos(pitch)))
    height = np.where(phase < steps.rise, 0.0, -FOOT_M * np.sin(pitch))
    along = np.where(swinging, hermite(s, left_at[0], steps.stride_m, left_with[0], 0.2 * swing_s), along)
    height = np.where(swinging, hermite(s, left_at[1], 0.0, left_with[1], -0.5 * swing_s), height)
    heel = np.stack([along + steps.stride_m * count, 0 * along, height + 0.03], -1)
    toe = heel + FOOT_M * np.stack([np.cos(pitch), 0 * pitch, np.sin(pitch)], -1)
    return heel, toe


def made_walk(
    rate: float = 100.0, seconds: float = 5.0, *, belt: bool = False, toes: bool = True, steps: Steps = WALK
) -> WalkPaths:
    """A walk along x; the left foot strikes at 0.3 s, the right half a cycle later."""
    time = np.arange(round(seconds * rate)) / rate
    speed = steps.stride_m / steps.cycle_s
    back = np.outer(speed * time if belt else 0 * time, [1.0, 0.0, 0.0])
    feet = []
    for side, delay, y in (("left", 0.3, 0.5 * WIDTH_M), ("right", 0.3 + 0.5 * steps.cycle_s, -0.5 * WIDTH_M)):
        heel, toe = foot_at(time, delay, steps)
        ahead = np.array([0.5 * speed * steps.cycle_s if side == "right" else 0.0, y, 0.0])
        feet.append(FootPath(side=side, heel=heel + ahead - back, toe=toe + ahead - back if toes else None))
    body = np.stack([speed * (time - 0.3) + 0.1 * steps.stride_m, 0 * time, 0.9 + 0 * time], -1) - back
    return WalkPaths(body=body, feet=tuple(feet), rate=rate)


def strikes(side: str, seconds: float = 5.0, steps: Steps = WALK) -> Floats:
    """Instants of the strikes [s]."""
    first = 0.3 if side == "left" else 0.3 + 0.5 * steps.cycle_s
    return np.arange(first, seconds - 0.05, steps.cycle_s)
