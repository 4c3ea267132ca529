"""Shapes of people: made people from points of their surface, and persons of rendered takes from silhouettes."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from bench.common import program
from bench.common.program import empty_frames, truth_of
from bench.intervals.of_motion import ALL_KINDS, of_joints, of_lengths
from bench.intervals.scoring import Sample, single
from bench.recording import Run
from bench.surface.shape import people, sample
from marey.body.metaballs.metaball_person import metaball_body, metaball_space
from marey.fit.points.levenberg import fit_points
from marey.fit.points.surface_points import PersonPoints

SEEDS = range(60, 68)
POINTS = 3000
"""Points of each of the two poses of a made person."""
MODEL_SD_M = 1e-4
"""Stated error of the model [m]: made people are of the model itself."""
SPANS = {"jacks": (40, 46), "stealth": (80, 86)}
"""First frame of each span, and the frame after its last, counted from the first that shows a person."""
OWN = 26
"""Shape parameters of the made people that differ from the mean: lengths and widths."""


def samples(run: Run) -> Iterator[Sample]:
    """Fit made people and those of the takes."""
    yield from made()
    for name, (first, end) in SPANS.items():
        yield from of_take(run, name, first, end)


def made() -> Iterator[Sample]:
    """Fit lengths and widths to points all round, and to points that one side alone shows."""
    space = metaball_space("simple")
    generic = replace(metaball_body(space), skeleton=space.mean.skeleton)
    for seed in SEEDS:
        for what, side in (("all round", None), ("one side", np.array([0.0, -1.0, 0.0]))):
            rng = np.random.default_rng(seed)
            body, poses, start = people(rng, space, 2, spread=0.03)
            points = {f: sample(body, pose, POINTS, rng, side=side) for f, pose in poses.items()}
            given = PersonPoints(by_frame=points, model_sd_m=MODEL_SD_M, scale_m=0.05)
            fit = fit_points(given, generic, start)
            error, sd = (fit.body.numbers - body.numbers)[:OWN], np.sqrt(np.diag(fit.covariance))[:OWN]
            yield single(f"sizes of made people, points {what}", f"seed {seed}", "1", error, sd)


def of_take(run: Run, name: str, first: int, end: int) -> Iterator[Sample]:
    """Fit the shape of a person of a take from silhouettes, and compare joint centres and lengths."""
    trial = run.shared / "data" / "people" / name
    empty, out = empty_frames(trial), run.out / "intervals" / "bodies" / name
    if not (out / "run.json").exists():
        program.shape(trial, out, preset="full", frames=range(first + empty, end + empty))
    with np.load(truth_of(trial)) as file:
        truth = {key: file[key][first:end] if file[key].ndim > 1 else file[key] for key in file.files}
    with np.load(out / "motion.npz") as file:
        motion = {key: file[key] for key in file.files}
    motion |= {key: motion[key][first + empty : end + empty] for key in ("joint_centres", "joint_centres_sd")}
    with np.load(out / "body.npz") as file:
        body = {key: file[key] for key in file.files}
    joints = of_joints(run, "`marey shape`", name, motion, body, truth, alone=True)
    yield from (each for each in joints if each.quantity != ALL_KINDS)
    yield replace(of_lengths(name, body, truth), quantity="lengths of limbs, `marey shape`")
