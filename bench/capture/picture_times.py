"""Takes of cameras with rolling shutters, and with frame rates of their own.

A made person who walks on the spot is filmed by four cameras of 640 x 480 px (`bench/common/made_room.py`). With a
rolling shutter the rows of a picture are exposed one after the other, so that moving limbs are bent. The joints are
those of the instants of the frames; errors are mean distances, and `steady` those without the constant offset of each
joint. Intervals are those of joint centres, without this offset.
"""

import argparse
from collections.abc import Sequence

import numpy as np

import marey
from bench.common.made_room import (
    LIMB_JOINTS,
    RATE,
    Filming,
    limb_joints,
    made_person,
    ring,
    walker_at,
    write_filmed_room,
)
from bench.common.program import capture
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.arrays import Floats

BENCH = Bench(
    measures="Joints from cameras with rolling shutters and different frame rates, against made truth.",
    sources=("src/marey/fit", "src/marey/io/video", "src/marey/pipelines/capture"),
    minutes=10,
    data=False,
)
SIZE, CAMERAS = (640, 480), 4
DURATION = 2.4
"""Length of the takes [s]: two cycles of the walk."""
READOUT_S = 0.02
FAST = 2 * RATE
"""Frame rate of the fast camera [Hz]."""
TAKES: tuple[tuple[str, tuple[Filming, ...], str], ...] = (
    ("all at once", (Filming(),) * CAMERAS, ""),
    ("rolling shutters, readout time given", (Filming(readout_s=READOUT_S),) * CAMERAS, f"readout_s = {READOUT_S}\n"),
    ("rolling shutters, readout time not given", (Filming(readout_s=READOUT_S),) * CAMERAS, ""),
    ("one camera at 60 Hz, three at 30 Hz", (Filming(rate=FAST), *(Filming(),) * (CAMERAS - 1)), ""),
    ("three cameras at 60 Hz, one at 30 Hz", (*(Filming(rate=FAST),) * (CAMERAS - 1), Filming()), ""),
)
"""Name, cameras and trial.toml of each take."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare no arguments."""


def run(run: Run) -> None:
    """Capture the takes."""
    table = run.table(
        "Pictures of their own times", "take", Column("joints", "mm", 1), Column("steady", "mm", 1),
        Column("95 % intervals hold", "", 3), Column("frames with a pose", "", 3),
    )  # fmt: skip
    body = made_person()
    for number, (name, filming, settings) in enumerate(TAKES):
        trial = write_filmed_room(
            run.out / str(number), ring(CAMERAS, SIZE).cameras, lambda time: walker_at(body, time), DURATION, filming
        )
        (trial / "trial.toml").write_text(settings, encoding="utf-8")
        motion = marey.load_motion(capture(trial, trial / "results"))
        truth = np.array([limb_joints(walker_at(body, time)) for time in motion.time])
        table.row(name, *_errors(motion, truth))


def _errors(motion: marey.Motion, truth: Floats) -> Sequence[float]:
    """Return mean error and mean steady error of joints [mm], share within the intervals, share of frames."""
    names = [motion.data.joint_names.index(name) for name in LIMB_JOINTS]
    off = motion.data.joint_centres[:, names] - truth
    steady = off - np.nanmean(off, axis=0)
    known = np.isfinite(off)
    held = np.abs(steady) < 1.96 * motion.data.joint_centres_sd[:, names]
    lengths = (1e3 * np.nanmean(np.linalg.norm(each, axis=2)) for each in (off, steady))
    return *map(float, lengths), float(held[known].mean()), float(known.all((1, 2)).mean())
