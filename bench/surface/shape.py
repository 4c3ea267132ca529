"""Fits of metaballs to points: how fast, in which order, by which residual; and the shape of a rendered arm.

`person`: a whole person and 100,000 points. `edges`: an arm with sharper and softer edges than the paper's. `orders`:
an arm in three frames, seen from one side. `arm`: `marey shape` on arm3 over what `marey surface` measures. `points`:
the same over true vertices with 0.3 mm of noise, without the errors of matching. `mirrored`: the same as `arm` on its
mirror image, a left arm on which nothing was tuned. `clicked`: the same as `arm` without images of the empty room, from
the joints of the arm clicked in one frame. `figure`: figure20, one instant from
20 sides. `walk`: `marey shape` from silhouettes alone.
"""

import argparse
import json
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.capture.takes import begin as begin_motion
from bench.capture.takes import fill as fill_motion
from bench.common import program
from bench.common.mirrored_takes import mirrored_take
from bench.common.parts import add_parts, run_parts
from bench.declaration import Bench
from bench.recording import Column, Run, Table
from bench.surface.arm import TRACKS, TRACKS_KEYS, values_of
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.metaballs.metaball_person import metaball_body, metaball_space, single_radii, vertex_limbs
from marey.body.metaballs.metaballs import PosedMetaballs
from marey.fit.points.levenberg import LevenbergSettings, fit_points
from marey.fit.points.surface_points import FramePoints, PersonPoints
from marey.fit.recipes.start_joints import CLICKED_SD_M
from marey.io.calibration.readers import read_rig
from marey.io.shapes.measured_surface import write_surface
from marey.surface.points.measured import MeasuredPoints

BENCH = Bench(
    measures="Fits of metaballs to points, and shapes of a rendered arm, a rendered walk and a real figure.",
    sources=("src/marey/fit", "src/marey/body", "src/marey/surface", "src/marey/pipelines/shape"),
    minutes=25,
)
NOISE, SEEN_BY = 3e-4, 3
CLICKED_FRAME, CLICKED_JOINTS = 37, ("r_shoulder", "r_elbow", "r_wrist")


def sample(body, pose, count, rng, *, side=None):
    """Points of the metaballs' surface with noise; where a direction is given, of what looks there only."""
    posed, balls = PosedBody(body, pose), body.metaballs.balls(body.numbers)
    corners = posed.vertices[body.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    which = rng.choice(len(area), (2 if side is None else 5) * count, p=area / area.sum())
    points = np.einsum("nc,nca->na", rng.dirichlet([1.0, 1.0, 1.0], len(which)), corners[which])
    surface = PosedMetaballs(balls, pose)
    points = surface.skin(points, vertex_limbs(body)[body.faces[which, 0]])
    on = np.abs(surface.distance(points)) < 1e-5
    if side is not None:
        on &= surface.nearest_limbs(points)[1] @ side > 0.2
    points = points[on][:count]
    covariance = np.broadcast_to(NOISE**2 * np.eye(3), (len(points), 3, 3))
    return FramePoints(points + rng.normal(size=points.shape) * NOISE, covariance)


def people(rng, space, frames, *, spread):
    """A person of the expected kind in some poses, and a start some centimetres and degrees away."""
    numbers = np.zeros(len(space))
    own = 26  # Lengths and widths; single radii stay.
    numbers[:own] = 0.5 * np.linalg.cholesky(space.prior_covariance[:own, :own]) @ rng.normal(size=own)
    body = replace(metaball_body(space, numbers), skeleton=space.mean.skeleton)
    rest = Pose(np.zeros(3), np.eye(3), np.zeros(len(body.skeleton) - 6))
    poses = {f: rest.step(np.append(np.zeros(6), rng.normal(size=len(rest.angles)) * 0.15)) for f in range(frames)}
    start = {f: p.step(rng.normal(size=len(body.skeleton)) * spread) for f, p in poses.items()}
    return body, poses, start


def joints_off(fit, body, poses):
    off = [
        PosedBody(fit.body, fit.poses[f]).segment_origin - PosedBody(body, p).segment_origin for f, p in poses.items()
    ]
    return 1e3 * np.linalg.norm(off, axis=-1)


def begin(run: Run, title: str, labels: str | tuple[str, ...]) -> Table:
    """Begin a table of fits."""
    return run.table(
        title,
        labels,
        Column("time", "s", 1),
        Column("steps"),
        Column("stopped"),
        Column("joints off, median", "mm", 2),
        Column("largest", "mm", 1),
        Column("numbers, RMS", "", 4),
    )


def fitted(table, name, points, space, body, poses, start, **changes):
    generic = replace(metaball_body(space), skeleton=space.mean.skeleton)
    began = time.perf_counter()
    fit = fit_points(points, generic, start, settings=LevenbergSettings(**changes))
    took, off = time.perf_counter() - began, joints_off(fit, body, poses)
    rms = np.sqrt(np.mean((fit.body.numbers - body.numbers) ** 2))
    table.row(name, took, len(fit.costs), str(fit.stopped), np.median(off), off.max(), rms)


def whole_person(run: Run) -> None:
    """Fit one frame of 100,000 points."""
    table = begin(run, "A whole person, 100,000 points, start off by 3 cm and 0.03 rad per coordinate", "fit")
    rng = np.random.default_rng(4)
    space = metaball_space("simple")
    segments = [name.rpartition("_")[2] for name in space.mean.skeleton.segment_names]
    single = single_radii(space, segments)
    for what, numbers in (("lengths and widths", space), ("lengths, widths, every radius and weight", single)):
        body, poses, start = people(rng, numbers, 1, spread=0.03)
        points = {f: sample(body, p, 100_000, rng) for f, p in poses.items()}
        given = PersonPoints(by_frame=points, model_sd_m=1e-3, scale_m=0.05)
        free = len(body.skeleton) + len(numbers)
        fitted(
            table, f"{len(space.mean)} metaballs, {free} unknowns: {what}", given, numbers, body,
            poses, start,
        )  # fmt: skip


def orders(run: Run) -> None:
    """Fit an arm of three frames seen from one side."""
    table = begin(run, "An arm in three frames seen from one side", ("seed", "order and residual"))
    space = metaball_space("simple")
    arm = ("shoulder_sweep", "shoulder_lift", "shoulder_turn", "elbow_flexion", "pronation", "wrist_flexion")
    skeleton = space.mean.skeleton
    kept = tuple(c for c in skeleton.coordinates if c.name in [f"right_{name}" for name in arm])
    space = replace(space, mean=replace(space.mean, skeleton=replace(skeleton, coordinates=kept)))
    for seed in (1, 2, 3):
        rng = np.random.default_rng(seed)
        body, poses, start = people(rng, space, 3, spread=0.05)
        points = {f: sample(body, p, 4000, rng, side=np.array([0.0, -1.0, 0.0])) for f, p in poses.items()}
        given = PersonPoints(by_frame=points, model_sd_m=1e-3, scale_m=0.05)
        for changes in (
            {"order": "together"}, {"order": "in turn"}, {"order": "together", "residual": "potential"},
        ):  # fmt: skip
            name = (str(seed), ", ".join(changes.values()))
            fitted(table, name, given, space, body, poses, start, iterations=60, stop=1e-5, **changes)


def edges(run: Run) -> None:
    """An arm with sharper and softer edges than the paper's, fitted with its weights and without."""
    columns = (Column("points"), Column("off, RMS", "mm", 2), Column("95 % within", "mm", 2))
    table = run.table("An arm with other edges", ("seed", "fitted"), *columns)
    space = metaball_space("simple")
    sharp = single_radii(space, ["upperarm", "forearm", "hand"])
    for seed in (1, 2, 3):
        rng = np.random.default_rng(seed)
        numbers = np.zeros(len(sharp))
        numbers[[n.endswith("sharpness") for n in sharp.names]] = rng.choice([-0.4, 0.4], 9)
        body = replace(metaball_body(sharp, numbers), skeleton=sharp.mean.skeleton)
        poses = {0: Pose(np.zeros(3), np.eye(3), np.zeros(len(body.skeleton) - 6))}
        arm = [sample(body, poses[0], 60_000, rng)]
        near = PosedBody(body, poses[0]).segment_origin[body.skeleton.segment("left_upperarm")]
        points = {0: arm[0][arm[0].points[:, 0] > near[0] + 0.05]}
        given = PersonPoints(by_frame=points, model_sd_m=3e-4, scale_m=0.02)
        for what, kept in (("radii alone", None), ("radii and weights", 0.1)):
            free = single_radii(space, ["upperarm", "forearm", "hand"], sharpness_sd=kept)
            start = replace(metaball_body(free), skeleton=free.mean.skeleton)
            fit = fit_points(given, start, poses)
            surface = PosedMetaballs(fit.body.metaballs.balls(fit.body.numbers), fit.poses[0])
            off = surface.distance(points[0].points)
            rms, high = np.sqrt(np.mean(off**2)), np.quantile(np.abs(off), 0.95)
            table.row((str(seed), what), len(off), 1e3 * rms, 1e3 * high)


def write_points(truth: Path, folder: Path) -> None:
    """Write the vertices that all cameras see, with noise, as if they had been measured."""
    rng, known = np.random.default_rng(0), np.load(truth)
    parts, names = [], [f"cam{i + 1:02d}" for i in range(3)]
    for frame, (vertices, seen) in enumerate(zip(known["vertices"], known["seen_by"], strict=True)):
        points = vertices[seen >= SEEN_BY].astype(float)
        count = len(points)
        parts.append(
            MeasuredPoints(
                frame=np.full(count, frame + int(known["empty"])),
                points=points + rng.normal(size=points.shape) * NOISE,
                covariance=np.broadcast_to(NOISE**2 * np.eye(3), (count, 3, 3)), camera_names=tuple(names),
                pixels=np.zeros((count, 3, 2)), correlation=np.ones((count, 3)), residual_px=np.zeros(count),
                colour=np.zeros((count, 3), np.uint8),
            )
        )  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    write_surface(folder / "surface.npz", parts, names)


def judge(run: Run, title: str, trial: Path, out: Path, preset: str) -> None:
    """Score skin, joints and trajectories."""
    truth = trial / "truth" / "truth.npz"
    skin = program.score(run, "surface.py", "--skin", out / "skin.npz", truth)
    columns = (Column("skin where seen, RMS", "mm", 2), Column("reached", "", 2))
    run.table(f"{title}: skin", "preset", *columns).row(preset, skin["rms_mm"], skin["reached"])
    joints = f"{preset.partition('_')[0]}_(shoulder|elbow|wrist)"
    fill_motion(
        begin_motion(run, f"{title}: joints", "preset"),
        preset,
        program.score(run, "capture.py", out, truth, "--joints", joints),
    )
    if (out / "trajectories.npz").is_file():
        scores = program.score(run, "surface.py", "--tracks", out / "trajectories.npz", truth)
        run.table(f"{title}: trajectories", "preset", *TRACKS).row(preset, *values_of(TRACKS_KEYS, scores))


def arm(run: Run) -> None:
    """Measure the arm's surface, and fit its shape."""
    trial, out = run.shared / "data" / "people" / "arm3", run.out / "shape" / "arm3"
    program.surface(trial, out, spacing=run.arguments.spacing)
    program.shape(trial, out, preset="right_arm")
    judge(run, f"arm3, a point every {run.arguments.spacing} px", trial, out, "right_arm")


def mirrored(run: Run) -> None:
    """Measure the surface of the mirrored arm, and fit its shape."""
    trial = mirrored_take(run.shared / "data" / "people" / "arm3", run.out / "shape" / "mirrored_trial")
    out = program.surface(trial, run.out / "shape" / "mirrored", spacing=run.arguments.spacing)
    program.shape(trial, out, preset="left_arm")
    judge(run, f"arm3 in a mirror, a point every {run.arguments.spacing} px", trial, out, "left_arm")


def clicked(run: Run) -> None:
    """Measure the arm's surface without the empty room, and fit its shape from clicked joints."""
    trial = run.shared / "data" / "people" / "arm3"
    without = without_empty_room(trial, run.out / "shape" / "clicked_trial")
    out = program.surface(without, run.out / "shape" / "clicked", spacing=run.arguments.spacing)
    program.shape(without, out, preset="right_arm", start=write_clicks(trial, run.out / "shape" / "clicks.json"))
    title = f"arm3, a point every {run.arguments.spacing} px, from clicked joints without the empty room"
    judge(run, title, trial, out, "right_arm")


def without_empty_room(trial: Path, folder: Path) -> Path:
    """Copy the videos and the cameras of a trial."""
    folder.mkdir(parents=True, exist_ok=True)
    for file in (*trial.glob("*.mp4"), trial / "cameras.toml"):
        shutil.copy(file, folder)
    return folder


def write_clicks(trial: Path, path: Path) -> Path:
    """Write the arm's joints in the images of one frame, as clicked by hand."""
    rng, content = np.random.default_rng(1999), {"frame": CLICKED_FRAME}
    with np.load(trial / "truth" / "truth.npz") as file:
        index = [list(file["joint_names"]).index(name) for name in CLICKED_JOINTS]
        joints = file["joints"][CLICKED_FRAME - int(file["empty"]), index]
    for camera in read_rig(trial / "cameras.toml"):
        away = np.linalg.norm(joints - camera.centre, axis=1)[:, None]
        pixels = camera.project(joints) + rng.normal(size=(len(index), 2)) * CLICKED_SD_M * camera.matrix[0, 0] / away
        names = (name.replace("r_", "right_") for name in CLICKED_JOINTS)
        content[camera.name] = dict(zip(names, pixels.round(1).tolist(), strict=True))
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def points(run: Run) -> None:
    """Fit the arm's shape to true vertices with noise."""
    trial, out = run.shared / "data" / "people" / "arm3", run.out / "shape" / "points"
    write_points(trial / "truth" / "truth.npz", out)
    program.shape(trial, out, preset="right_arm")
    judge(run, "arm3, true vertices with 0.3 mm of noise", trial, out, "right_arm")


def figure(run: Run) -> None:
    """Fit the shape of figure20."""
    trial = run.shared / "data" / "surface" / "figure20"
    out = program.shape(trial, run.out / "shape" / "figure20")
    scores = program.score(run, "masks.py", out, trial / "masks", "--of", "surface_masks")
    table = run.table("figure20, 20 sides", "body", Column("surface IoU", "", 3), Column("worst view", "", 3))
    table.row("`marey shape`", scores["iou"], scores["iou_worst"])


def walk(run: Run) -> None:
    """Fit the shape of a walking person from silhouettes alone."""
    trial = run.shared / "data" / "people" / "walk"
    out, skip = run.out / "shape" / "walk", ("--skip-empty", program.empty_frames(trial))
    program.shape(trial, out, preset="full")
    fill_motion(
        begin_motion(run, "walk, silhouettes alone", "take"),
        "walk",
        program.score(run, "capture.py", out, program.truth_of(trial), *skip),
    )
    scores = program.score(run, "masks.py", out, trial / "truth" / "masks.npz", *skip, "--of", "surface_masks")
    run.table("walk, surface", "take", Column("surface IoU", "", 3)).row("walk", scores["iou"])


PARTS = {
    "person": whole_person,
    "edges": edges,
    "orders": orders,
    "arm": arm,
    "points": points,
    "mirrored": mirrored,
    "clicked": clicked,
    "figure": figure,
    "walk": walk,
}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_parts(parser, PARTS)
    parser.add_argument("--spacing", type=int, default=4, help="pixels from point to point of `arm`")


def run(run: Run) -> None:
    """Run the parts."""
    run_parts(run, PARTS)
