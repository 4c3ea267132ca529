"""A made walker on stairs, or on a level floor, whose heels or toes land first, with known instants of strike."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.motion.events.feet import FootPath, WalkPaths
from tests.made_steps import FOOT_M, WIDTH_M, hermite


@dataclass(frozen=True, kw_only=True)
class StairSteps:
    """How the feet move; each foot takes every other step of the stairs."""

    cycle_s: float = 1.4
    stride_m: float = 0.56
    """Two steps of the stairs [m]."""
    rise_m: float = 0.34
    """Height that a foot gains in a stride [m]; below zero downstairs."""
    land_deg: float = -15.0
    """Slope of the sole at the strike: above zero the heel lands first, below zero the toe."""
    stand_deg: float = 0.0
    """Slope of the sole in stance; below zero only the front of the foot is on the step."""
    lift_deg: float = -60.0
    """Slope of the sole when the foot leaves the step."""
    flat: float = 0.10
    """Phase at which the slope of stance is reached."""
    rise: float = 0.42
    """Phase at which the heel rises."""
    off: float = 0.63
    """Phase at which the toe begins to leave the step."""
    clear_m: float = 0.08
    """Height by which the swinging foot passes above the way from step to step."""
    sink_m_s: float = -0.4
    """Vertical velocity of the landing point just before the strike."""


STAIRS = {
    "level, heel first": StairSteps(cycle_s=1.1, stride_m=1.2, rise_m=0.0, land_deg=20.0, clear_m=0.0, sink_m_s=-0.5),
    "level, toe first": StairSteps(cycle_s=1.1, stride_m=1.0, rise_m=0.0, land_deg=-20.0, clear_m=0.03),
    "up, heel first": StairSteps(land_deg=5.0),
    "up, toe first": StairSteps(),
    "up, on the front of the foot": StairSteps(stand_deg=-8.0),
    "down, toe first": StairSteps(rise_m=-0.34, land_deg=-30.0, lift_deg=-45.0, clear_m=0.1),
    "down, heel first": StairSteps(rise_m=-0.34, land_deg=10.0, lift_deg=-45.0, clear_m=0.1),
    "down slowly, toe first": StairSteps(cycle_s=1.9, rise_m=-0.34, land_deg=-30.0, lift_deg=-45.0, clear_m=0.1),
}
"""Walks by name."""


def foot_on_stairs(time: Floats, delay: float, steps: StairSteps) -> tuple[Floats, Floats]:
    """Heel and toe (F, 3) of a foot that strikes at `delay` + k cycles, going along x."""
    count, phase = np.divmod((time - delay) / steps.cycle_s, 1.0)
    swing_s = (1 - steps.off) * steps.cycle_s
    lift, land, stand = np.radians([steps.lift_deg, steps.land_deg, steps.stand_deg])
    rise = np.clip((phase - steps.rise) / (steps.off - steps.rise), 0, 1)
    s = np.clip((phase - steps.off) / (1 - steps.off), 0, 1)
    rate = 2 * (lift - stand) / ((steps.off - steps.rise) * steps.cycle_s)
    swinging = phase > steps.off
    lowering = stand + (land - stand) * (1 - phase / steps.flat)
    slope = np.where(phase < steps.flat, lowering, stand + (lift - stand) * rise**2)
    slope = np.where(swinging, hermite(s, lift, land, rate * swing_s, 0.0), slope)
    # The foot turns about the toe where it points down, otherwise about the heel.
    along = np.where(slope < 0, FOOT_M * (1 - np.cos(slope)), 0.0)
    height = np.where(slope < 0, -FOOT_M * np.sin(slope), 0.0)
    start = FOOT_M * np.array([1 - np.cos(lift), -np.sin(lift)])
    leaves = rate * FOOT_M * np.array([np.sin(lift), -np.cos(lift)]) * swing_s
    end = FOOT_M * np.array([1 - np.cos(land), -np.sin(land)]) * (land < 0) + [steps.stride_m, steps.rise_m]
    along = np.where(swinging, hermite(s, start[0], end[0], leaves[0], 0.2 * swing_s), along)
    way = hermite(s, start[1], end[1], leaves[1], steps.sink_m_s * swing_s)
    height = np.where(swinging, way + 16 * steps.clear_m * s**2 * (1 - s) ** 2, height)
    heel = np.stack([along + steps.stride_m * count, 0 * along, height + steps.rise_m * count + 0.03], -1)
    return heel, heel + FOOT_M * np.stack([np.cos(slope), 0 * slope, np.sin(slope)], -1)


def stair_walk(
    steps: StairSteps, *, rate: float = 100.0, seconds: float = 6.0, noise_m: float = 0.0, seed: int = 0
) -> WalkPaths:
    """A walk along x with white noise per axis; the left foot strikes at 0.3 s, the right one half a cycle later."""
    time, rng = np.arange(round(seconds * rate)) / rate, np.random.default_rng(seed)
    feet = []
    for side, delay, y, ahead in (
        ("left", 0.3, 0.5 * WIDTH_M, 0.0), ("right", 0.3 + 0.5 * steps.cycle_s, -0.5 * WIDTH_M, 0.5)
    ):  # fmt: skip
        moved = np.array([ahead * steps.stride_m, y, ahead * steps.rise_m])
        points = [point + moved for point in foot_on_stairs(time, delay, steps)]
        heel, toe = (point + noise_m * rng.normal(size=point.shape) for point in points)
        feet.append(FootPath(side=side, heel=heel, toe=toe))
    done = (time - 0.3) / steps.cycle_s
    body = np.stack([steps.stride_m * (done + 0.1), 0 * time, 0.9 + steps.rise_m * done], -1)
    return WalkPaths(body=body, feet=tuple(feet), rate=rate)


def stair_strikes(steps: StairSteps, side: str, seconds: float = 6.0) -> Floats:
    """Instants of the strikes [s], without those that are nearer to the ends than an extreme can be seen."""
    first = 0.3 if side == "left" else 0.3 + 0.5 * steps.cycle_s
    return np.arange(first, seconds - 0.06, steps.cycle_s)
