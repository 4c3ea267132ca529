"""Instants of jumps and squats of captured people against the true surface of the body.

The true flight of a jump is the time in which all vertices of the true surface are 5 mm above the floor, by linear
interpolation between frames. The floor is the median height of the lowest vertex while the person stands; it varies by
10 mm, a third of a frame. The true lowest place of a squat is that of the true pelvis.
"""

import numpy as np
from scipy.constants import g as gravity

import marey
from bench.common.program import capture, empty_frames, truth_of
from bench.declaration import Bench
from bench.recording import Column, Run, Table
from marey.arrays import Floats, true_runs

BENCH = Bench(
    measures="Errors of take-off, landing, jump height and squats in captures, with their stated uncertainty.",
    sources=("src/marey/motion/events/repetitions.py", "src/marey/motion/events/body_feet.py"),
    minutes=5,
)
_CLEAR_M = 0.005
"""Height of the lowest vertex above the floor from which on the true body is in the air [m]."""
_HIGHEST_M = 0.025
"""Height that the lowest vertex reaches in a flight [m]."""
_TAKES = ("jacks", "reach", "walk")
"""Jumping jacks, two squats, and a walk, which has no repetitions."""
_NONE: Floats = np.zeros((0, 2))
"""The flights of a take without jumps."""


def run(run: Run) -> None:
    """Capture the takes, and compare the repetitions with the truth."""
    columns = (Column("found", "", 0), Column("true", "", 0), Column("mean error", "ms", 0), Column("spread", "ms", 0))
    table = run.table("Instants", ("take", "instant"), *columns, Column("within 1.96 sd", "%", 0))
    centimetres = (Column("true", "cm", 1), Column("found", "cm", 1), Column("standard deviation", "cm", 1))
    heights = run.table("Jump heights", "jump", *centimetres)
    for take in _TAKES:
        trial = run.shared / "data" / "people" / take
        motion = marey.load_motion(capture(trial, run.out / "repetitions" / take))
        truth, start = np.load(truth_of(trial)), empty_frames(trial) / motion.rate
        jumps = [each.flight for each in motion.repetitions if each.flight is not None]
        flights = start + _flights(truth["vertices"][:, :, 2].min(1)) / motion.rate if take == "jacks" else _NONE
        sds = np.array([flight.sd_s for flight in jumps])
        for k, name in enumerate(("take-off", "landing")):
            own = np.array([(flight.takeoff_s, flight.landing_s)[k] for flight in jumps])
            _compare(table, (take, name), own, flights[:, k], sds)
        for number, (flight, (takeoff, landing)) in enumerate(zip(jumps, flights, strict=False), 1):
            true = gravity * (landing - takeoff) ** 2 / 8
            heights.row(str(number), 100 * true, 100 * flight.height_m, 100 * flight.height_sd_m)
        lowest = np.array([each.lowest_s for each in motion.repetitions if each.kind == "squat"])
        pelvis = truth["joints"][:, list(truth["joint_names"]).index("pelvis"), 2]
        squats = start + _lowest(pelvis) / motion.rate if take == "reach" else np.zeros(0)
        _compare(table, (take, "lowest place of a squat"), lowest, squats, None)


def _compare(table: Table, labels: tuple[str, str], own: Floats, true: Floats, sds: Floats | None) -> None:
    """Write a row: numbers of instants, and their errors if as many were found as there are."""
    if len(own) != len(true) or not len(true):
        table.row(labels, len(own), len(true), None, None, None)
        return
    errors = own - true
    held = None if sds is None else 100 * float(np.mean(np.abs(errors) < 1.96 * sds))
    table.row(labels, len(own), len(true), 1e3 * errors.mean(), 1e3 * errors.std(ddof=1), held)


def _flights(lowest: Floats) -> Floats:
    """Return first and last instant (N, 2) in the air, in frames, from heights (F,) of the lowest vertex [m]."""
    above = lowest - np.median(lowest[lowest < np.quantile(lowest, 0.6)]) - _CLEAR_M
    found = []
    for start, end in true_runs(np.asarray(above > 0)):
        if above[start:end].max() > _HIGHEST_M:
            takeoff = start - above[start] / (above[start] - above[start - 1])
            landing = end - above[end] / (above[end] - above[end - 1])
            found.append((takeoff, landing))
    return np.array(found).reshape(-1, 2)


def _lowest(height: Floats) -> Floats:
    """Return the instants of the lowest places of the halves of a curve, in frames, by a parabola."""
    half = len(height) // 2
    found = []
    for first in (0, half):
        k = first + int(np.argmin(height[first : first + half]))
        before, at, after = height[k - 1 : k + 2]
        found.append(k + 0.5 * (before - after) / (before - 2 * at + after))
    return np.array(found)
