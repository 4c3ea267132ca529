"""Foot strikes on stairs and of feet whose toes land first, of a made walker with known instants.

No recording of stairs with truth was available. The made feet rest exactly on the steps and land with 0.4 m/s; the
corrections of the methods are those of the walks with force plates. Offs are not compared, because a made toe begins to
move without a force plate to define when it has left. `heels only` leaves the toes out, so that the strike is that of
the heel.
"""

import argparse
from dataclasses import replace

import numpy as np
from tests.made_stairs import STAIRS, StairSteps, stair_strikes, stair_walk

from bench.declaration import Bench
from bench.recording import Column, Run
from marey.motion.events.cycles import STRIKE
from marey.motion.events.detection import find_events
from marey.motion.events.feet import FootPath, WalkPaths

BENCH = Bench(
    measures="Foot strikes of a made walker on stairs, whose heels or toes land first.",
    sources=("src/marey/motion/events",),
    minutes=1,
    data=False,
)
NEAR_S = 0.1
"""A strike is found if one of its side lies within this time [s]."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--noises", nargs="+", type=float, default=[0.0, 0.3, 1.0], help="noise per axis in mm")
    parser.add_argument("--draws", type=int, default=10, help="draws of the noise")


def compared(walk: WalkPaths, steps: StairSteps) -> tuple[list[float], list[float], int]:
    """Return errors [ms], the same in stated standard deviations, and how many strikes are missed or wrong."""
    found = [event for event in find_events(walk) if event.kind == STRIKE]
    off, scaled, hits, true = [], [], 0, 0
    for side in ("left", "right"):
        own = [event for event in found if event.side == side]
        for time in stair_strikes(steps, side):
            true += 1
            near = min(own, key=lambda event: abs(event.time - time), default=None)
            if near is not None and abs(near.time - time) <= NEAR_S:
                hits += 1
                off.append(1e3 * (near.time - time))
                scaled.append((near.time - time) / (near.sd_s or np.nan))
    return off, scaled, true + len(found) - 2 * hits


def run(run: Run) -> None:
    """Find the strikes with heels and toes, and with heels only."""
    table = run.table(
        "Strikes of a made walker", ("walk", "noise", "points"), Column("F1", "", 3), Column("bias", "ms", 1),
        Column("spread", "ms", 1), Column("within 1.96 stated sd", "", 2),
        note=f"100 Hz; {run.arguments.draws} draws of white noise per axis.",
    )  # fmt: skip
    for name, steps in STAIRS.items():
        for noise in run.arguments.noises:
            draws = range(run.arguments.draws if noise else 1)
            walks = [stair_walk(steps, noise_m=1e-3 * noise, seed=seed) for seed in draws]
            heels = [replace(w, feet=tuple(FootPath(side=f.side, heel=f.heel) for f in w.feet)) for w in walks]
            for points, each in (("heels and toes", walks), ("heels only", heels)):
                results = [compared(walk, steps) for walk in each]
                off, scaled = (np.concatenate([result[k] for result in results]) for k in (0, 1))
                wrong = sum(result[2] for result in results)
                if len(off):
                    cells = [float(off.mean()), float(off.std()), float(np.mean(np.abs(scaled) < 1.96))]
                else:
                    cells = [None, None, None]
                table.row((name, f"{noise:g} mm", points), 2 * len(off) / (2 * len(off) + wrong), *cells)
