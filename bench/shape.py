"""Fits of metaballs to points: how fast, in which order, by which residual; and points as a perfect matcher gives them.

    python bench/shape.py                        a whole person and 100,000 points; edges; an arm in three frames
    python bench/shape.py points TRUTH.npz DIR   DIR/surface.npz: vertices that all cameras see, with 0.3 mm of noise
    python bench/shape.py arm SHARED OUT [TRIAL PRESET [FRAMES]]

The second form takes a rendered take's truth (people/arm3), so that `marey shape` can be judged without the matching.
The third runs `marey shape` on arm3 as a right arm (or on TRIAL, such as the mirrored one of bench/tracking.py, or its
first FRAMES frames), over what `marey surface TRIAL --out OUT` left: how long each stage took, and the scores of skin,
joints and tracks, those of the tracks before it too.
"""

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from marey.body.articulation.pose import Pose, PosedBody
from marey.body.metaballs.metaball_person import metaball_body, metaball_space, single_radii, vertex_limbs
from marey.body.metaballs.metaballs import PosedMetaballs
from marey.fit.points.levenberg import LevenbergSettings, fit_points
from marey.fit.points.surface_points import FramePoints, PersonPoints
from marey.io.shapes.measured_surface import write_surface
from marey.io.trial.trial import read_trial
from marey.pipelines.capture.settings import CaptureSettings
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.shape.shape import shape_trial
from marey.process import tuned_process
from marey.surface.points.measured import MeasuredPoints

NOISE, SEEN_BY = 3e-4, 3


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


def fitted(name, points, space, body, poses, start, **changes):
    generic = replace(metaball_body(space), skeleton=space.mean.skeleton)
    began = time.perf_counter()
    fit = fit_points(points, generic, start, settings=LevenbergSettings(**changes))
    took, off = time.perf_counter() - began, joints_off(fit, body, poses)
    sys.stdout.write(
        f"{name}: {took:.1f} s, {len(fit.costs)} steps ({fit.stopped}); joints {np.median(off):.2f} mm off (median), "
        f"largest {off.max():.1f}; numbers {np.sqrt(np.mean((fit.body.numbers - body.numbers) ** 2)):.4f} rms\n"
    )
    sys.stdout.flush()


def whole_person():
    rng = np.random.default_rng(4)
    space = metaball_space("simple")
    segments = [name.rpartition("_")[2] for name in space.mean.skeleton.segment_names]
    single = single_radii(space, segments)
    for what, numbers in (("lengths and widths", space), ("and every radius and weight", single)):
        body, poses, start = people(rng, numbers, 1, spread=0.03)
        points = {f: sample(body, p, 100_000, rng) for f, p in poses.items()}
        given = PersonPoints(by_frame=points, model_sd_m=1e-3, scale_m=0.05)
        free = len(body.skeleton) + len(numbers)
        fitted(
            f"{len(points[0])} points, {len(space.mean)} metaballs, {free} unknowns ({what})", given, numbers, body,
            poses, start,
        )  # fmt: skip


def orders():
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
            name = f"seed {seed}, 3 frames seen from one side, {', '.join(changes.values())}"
            fitted(name, given, space, body, poses, start, iterations=60, stop=1e-5, **changes)


def edges():
    """An arm with sharper and softer edges than the paper's, fitted with its weights and without."""
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
            sys.stdout.write(
                f"an arm of other edges, seed {seed}, {what}: {len(off)} points, "
                f"{1e3 * np.sqrt(np.mean(off**2)):.2f} mm rms, 95 % within {1e3 * np.quantile(np.abs(off), 0.95):.2f}\n"
            )


def write_points(truth, folder):
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


def arm(shared, out, trial, preset, frames):
    truth, score = trial / "truth" / "truth.npz", shared / "score"

    def told(script, *arguments):
        command = [sys.executable, score / script, *map(str, arguments)]
        lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip().splitlines()
        sys.stdout.write(f"  {script} {arguments[0] if script == 'surface.py' else ''}: {lines[-1]}\n")

    if (out / "trajectories.npz").is_file():
        sys.stdout.write("before\n")
        told("surface.py", "--tracks", out / "trajectories.npz", truth)
    began = time.perf_counter()
    options = CaptureSettings(out=out, preset=preset, frames=(0, frames) if frames else None, overlay=False)
    shape_trial(read_trial(trial, **options.changes()), options, RecordingProgress())
    took = json.loads((out / "run.json").read_text())["timings_s"]
    sys.stdout.write(f"marey shape {trial.name} --preset {preset}: {time.perf_counter() - began:.0f} s, {took}\n")
    told("surface.py", "--skin", out / "skin.npz", truth)
    if (out / "trajectories.npz").is_file():
        told("surface.py", "--tracks", out / "trajectories.npz", truth)
    told("capture.py", out, truth, "--joints", f"{preset.partition('_')[0]}_(shoulder|elbow|wrist)")


@tuned_process()
def main() -> None:
    if sys.argv[1:2] == ["arm"]:
        shared, out, *rest = sys.argv[2:]
        trial = Path(rest[0]) if rest else Path(shared) / "data" / "people" / "arm3"
        preset, frames = (rest[1] if len(rest) > 1 else "right_arm"), (int(rest[2]) if len(rest) > 2 else 0)
        arm(Path(shared), Path(out), trial, preset, frames)
        return
    if sys.argv[1:2] == ["points"]:
        write_points(Path(sys.argv[2]), Path(sys.argv[3]))
        return
    with threadpool_limits(1):
        whole_person()
        edges()
        orders()


if __name__ == "__main__":
    main()
