"""People who turn once round before three cameras: made takes with exact truth.

Each seed draws a person of sixteen family numbers, more than the fitted body has, turns them through 360 degrees in
three seconds while arms and legs swing, and roughens the silhouettes of three cameras by a pixel. Start, tracking,
shape and refinement are those of `marey capture`.
"""

import argparse

import cv2
import numpy as np

from bench.declaration import Bench
from bench.recording import Column, Run
from marey.arrays import Floats, Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.body.people.person import family_body, person_body
from marey.cameras.camera import Camera
from marey.fit.recipes.person import (
    PersonSettings,
    SilhouetteTake,
    refine_person,
    repair_person,
    shape_frames,
    start_person,
    track_person,
    with_shape,
)
from marey.fit.recipes.sequence import join_pieces
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.observations.correspondence import view_of

BENCH = Bench(
    measures="Joints and heading of made people who turn once round, against exact truth.",
    sources=("src/marey/fit", "src/marey/body", "src/marey/observations"),
    minutes=4,
    data=False,
)
RATE, FRAMES, SIZE, FOCAL, DISTANCE = 30.0, 90, (480, 400), 600.0, 3.4
LIMBS = [f"{s}_{j}" for s in ("left", "right") for j in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")]


def cameras(count: int = 3) -> tuple[Camera, ...]:
    """Return cameras that look level at the middle of the room, none opposite another."""
    matrix = np.array([[FOCAL, 0, (SIZE[0] - 1) / 2], [0, FOCAL, (SIZE[1] - 1) / 2], [0, 0, 1]])
    upright = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    ring = []
    for i in range(count):
        turn = upright @ rotations.about(np.array([0, 0, 1.0]), 0.3 + 1.8 * i)
        pose = RigidTransform(turn, np.array([0.0, 0.0, DISTANCE]))
        ring.append(Camera(name=f"cam{i}", size=SIZE, matrix=matrix, distortion=np.zeros(4), camera_from_world=pose))
    return tuple(ring)


def pose_at(body: Body, frame: int, rng_phase: float) -> Pose:
    """The pose of a frame: a turn about the vertical, arms and legs swinging."""
    phase = rng_phase + 2 * np.pi * frame / 36
    names = [c.name for c in body.skeleton.coordinates]
    angles = np.zeros(len(names))
    for name, middle, width in (
        ("left_shoulder_lift", 25, 20), ("right_shoulder_lift", 15, -15), ("left_elbow_flexion", 45, 25),
        ("right_elbow_flexion", 30, -20), ("right_hip_flexion", 12, 22), ("left_hip_flexion", 12, -22),
        ("left_knee_flexion", 22, 18), ("right_knee_flexion", 22, -18),
    ):  # fmt: skip
        angles[names.index(name)] = np.deg2rad(middle + width * np.sin(phase))
    turn = rotations.about(np.array([0, 0, 1.0]), 2 * np.pi * frame / FRAMES)
    return Pose(np.array([0.15 * np.sin(phase / 2), 0.1 * np.cos(phase / 2), 0.0]), turn, angles)


def rough(mask: Mask, rng: np.random.Generator) -> Mask:
    """Move an outline in and out by smooth noise of one pixel."""
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    noise = cv2.GaussianBlur(rng.normal(size=mask.shape), (0, 0), 3.0)
    return np.asarray(np.where(mask, inside - 0.5, 0.5 - outside) + noise / noise.std() > 0)


def made_take(seed: int) -> tuple[SilhouetteTake, list[PosedBody]]:
    """Draw a person, turn them round, and see them."""
    rng = np.random.default_rng(seed)
    mean = family_body("fine")
    person = mean.with_numbers(0.8 * rng.normal(size=len(mean.numbers)))
    begun = rng.uniform(0, 2 * np.pi)
    truth = [PosedBody(person, pose_at(person, frame, begun)) for frame in range(FRAMES)]
    seeing = cameras()
    masks = [[rough(view_of(posed, camera).mask(), rng) for camera in seeing] for posed in truth]
    return SilhouetteTake(seeing, lambda frame: masks[frame], tuple(range(FRAMES)), RATE), truth


def captured(take: SilhouetteTake) -> list[PosedBody]:
    """Find the person and follow them, as `marey capture` does once the silhouettes are known."""
    settings = PersonSettings()
    coarse, fine = (person_body(level) for level in ("coarse", "fine"))
    found = start_person(take, coarse, fine, settings)
    if found is None:
        raise SystemExit("no start was found")
    frame, begun = found
    body = begun.posed.body
    tracked = track_person(take, body, with_shape(body, coarse), (frame, begun.posed.pose), settings)
    scores = {f: candidate.score for f, candidate in tracked.items()}
    poses = {f: candidate.posed.pose for f, candidate in tracked.items()}
    for height in (settings.track_height, settings.fine_height):
        chosen = shape_frames(scores, settings.shape_frames)
        fit = join_pieces(list(refine_person(take, body, poses, chosen, settings, height=height, rounds=4)))
        body, poses = fit.body, dict(zip(map(int, fit.frames), fit.poses, strict=True))
        if height == settings.track_height:
            poses = repair_person(take, body, with_shape(body, coarse), poses, settings)
    return [PosedBody(body, poses[f]) for f in sorted(poses)]


def limbs(posed: PosedBody) -> Floats:
    """The limbs' joint centres (12, 3)."""
    names = list(posed.body.joint_names)
    return posed.segment_origin[posed.body.joint_segments[[names.index(name) for name in LIMBS]]]


def turn_error(found: PosedBody, true: PosedBody) -> float:
    """The angle between the pelves' headings [degrees]."""
    ahead = [p.pose.rotation[:2, 1] for p in (found, true)]
    return float(np.degrees(abs(np.arctan2(np.linalg.det(ahead), ahead[0] @ ahead[1]))))


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("seeds", nargs="*", type=int, help="0, 1 and 2 without any")


def run(run: Run) -> None:
    """Make and follow one take per seed."""
    columns = (
        Column("frames followed"),
        Column("joints", "mm", 1),
        Column("worst single joint", "mm", 0),
        Column("heading off by at most", "deg", 1),
    )
    table = run.table(f"People who turn once round in {FRAMES} frames, three cameras", "seed", *columns)
    for seed in run.arguments.seeds or (0, 1, 2):
        take, truth = made_take(seed)
        found = captured(take)
        errors = 1e3 * np.array(
            [np.linalg.norm(limbs(a) - limbs(b), axis=1) for a, b in zip(found, truth, strict=True)]
        )
        turns = max(turn_error(a, b) for a, b in zip(found, truth, strict=True))
        table.row(str(seed), len(found), errors.mean(), errors.max(), turns)
