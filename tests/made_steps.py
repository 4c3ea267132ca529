"""A made walker: heels, toes and body with known instants of strike and off, over ground, on a belt or in a turn."""

import numpy as np

from marey.arrays import Floats
from marey.motion.events.feet import FootPath, WalkPaths

CYCLE_S, STRIDE_M, WIDTH_M, FOOT_M = 1.1, 1.32, 0.12, 0.2
"""Cycle of each foot, its stride, the distance between the lines of the feet, and the length of a foot."""
FLAT, RISE, OFF_SHARE = 0.08, 0.40, 0.62
"""Phases of a foot at which the toe is down, the heel rises, and the foot leaves the floor."""


def hermite(share: Floats, start: float, end: float, slope: float, end_slope: float) -> Floats:
    s = share
    return (
        (2 * s**3 - 3 * s**2 + 1) * start + (s**3 - 2 * s**2 + s) * slope
        + (-2 * s**3 + 3 * s**2) * end + (s**3 - s**2) * end_slope
    )  # fmt: skip


def foot_at(time: Floats, delay: float) -> tuple[Floats, Floats]:
    """Heel and toe (F, 3) of a foot that strikes at `delay` + k cycles, walking along x."""
    count, phase = np.divmod((time - delay) / CYCLE_S, 1.0)
    swing_s = (1 - OFF_SHARE) * CYCLE_S
    lift, down = np.radians(-60.0), np.radians(20.0)
    rise = np.clip((phase - RISE) / (OFF_SHARE - RISE), 0, 1)
    s = np.clip((phase - OFF_SHARE) / (1 - OFF_SHARE), 0, 1)
    rate = 2 * lift / ((OFF_SHARE - RISE) * CYCLE_S)
    swinging = phase > OFF_SHARE
    pitch = np.where(phase < FLAT, down * (1 - phase / FLAT), lift * rise**2)
    pitch = np.where(swinging, hermite(s, lift, down, rate * swing_s, 0.0), pitch)
    left_at = FOOT_M * np.array([1 - np.cos(lift), -np.sin(lift)])  # the heel when the foot leaves the floor
    left_with = rate * FOOT_M * np.array([np.sin(lift), -np.cos(lift)]) * swing_s
    along = np.where(phase < RISE, 0.0, FOOT_M * (1 - np.cos(pitch)))
    height = np.where(phase < RISE, 0.0, -FOOT_M * np.sin(pitch))
    along = np.where(swinging, hermite(s, left_at[0], STRIDE_M, left_with[0], 0.2 * swing_s), along)
    height = np.where(swinging, hermite(s, left_at[1], 0.0, left_with[1], -0.5 * swing_s), height)
    heel = np.stack([along + STRIDE_M * count, 0 * along, height + 0.03], -1)
    toe = heel + FOOT_M * np.stack([np.cos(pitch), 0 * pitch, np.sin(pitch)], -1)
    return heel, toe


def made_walk(rate: float = 100.0, seconds: float = 5.0, *, belt: bool = False, toes: bool = True) -> WalkPaths:
    """A walk along x; the left foot strikes at 0.3 s, the right half a cycle later."""
    time = np.arange(round(seconds * rate)) / rate
    speed = STRIDE_M / CYCLE_S
    back = np.outer(speed * time if belt else 0 * time, [1.0, 0.0, 0.0])
    feet = []
    for side, delay, y in (("left", 0.3, 0.5 * WIDTH_M), ("right", 0.3 + 0.5 * CYCLE_S, -0.5 * WIDTH_M)):
        heel, toe = foot_at(time, delay)
        ahead = np.array([0.5 * speed * CYCLE_S if side == "right" else 0.0, y, 0.0])
        feet.append(FootPath(side=side, heel=heel + ahead - back, toe=toe + ahead - back if toes else None))
    body = np.stack([speed * (time - 0.3) + 0.1 * STRIDE_M, 0 * time, 0.9 + 0 * time], -1) - back
    return WalkPaths(body=body, feet=tuple(feet), rate=rate)


def strikes(side: str, seconds: float = 5.0) -> Floats:
    """Instants of the strikes [s]."""
    first = 0.3 if side == "left" else 0.3 + 0.5 * CYCLE_S
    return np.arange(first, seconds - 0.05, CYCLE_S)
