"""Refinement of takes of many frames: memory stays bounded, time grows with the frames, and windows change nothing.

The person is the family's mean, walking on the spot before four small cameras; silhouettes are drawn on demand, so
that only the refinement is measured. Intermediate results go to a folder that is deleted. `--compare` refines the
same frames in one system and in windows and states the differences in units of the standard deviations.
"""

import argparse
import resource
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench.declaration import Bench
from bench.recording import Column, Run, Table
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.body.people.person import person_body
from marey.cameras.camera import Camera
from marey.fit.recipes import sequence
from marey.fit.recipes.sequence import RefineCheckpoint, SequenceFit, refine_in_pieces
from marey.fit.search.levels import FrameLevels
from marey.fit.solver.banded import windows
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.io.stages import FrameLog
from marey.motion.from_fit import measure_piece
from marey.observations.correspondence import view_of
from marey.pipelines.kept_candidates import KeptArrays

BENCH = Bench(
    measures="Time and memory of the refinement of long takes, and the effect of its windows.",
    sources=("src/marey/fit", "src/marey/body", "src/marey/observations"),
    minutes=12,
    data=False,
)

RATE, SIZE, FOCAL, DISTANCE, ROUNDS = 30.0, (160, 200), 220.0, 3.2, 3


def cameras(count: int = 4) -> tuple[Camera, ...]:
    """Return small cameras all round."""
    matrix = np.array([[FOCAL, 0, (SIZE[0] - 1) / 2], [0, FOCAL, (SIZE[1] - 1) / 2], [0, 0, 1]])
    ring = []
    for i in range(count):
        turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) @ rotations.about(np.array([0, 0, 1.0]), 0.4 + 1.4 * i)
        pose = RigidTransform(turn, np.array([0.0, 0.0, DISTANCE]))
        ring.append(Camera(name=f"cam{i}", size=SIZE, matrix=matrix, distortion=np.zeros(4), camera_from_world=pose))
    return tuple(ring)


def pose_at(body: Body, frame: int) -> Pose:
    """Return a smooth motion: the person turns slowly, and arms and legs swing."""
    phase = 2 * np.pi * frame / 40
    names = [c.name for c in body.skeleton.coordinates]
    angles = np.zeros(len(names))
    for name, middle, width in (
        ("left_shoulder_lift", 40, 20), ("right_shoulder_lift", 10, -20), ("left_elbow_flexion", 50, 20),
        ("right_hip_flexion", 20, 25), ("left_knee_flexion", 30, 20),
    ):  # fmt: skip
        angles[names.index(name)] = np.deg2rad(middle + width * np.sin(phase))
    turn = rotations.about(np.array([0, 0, 1.0]), 0.01 * frame)
    return Pose(np.array([0.1 * np.sin(phase), 0.0, -0.05]), turn, angles)


class Seen:
    """Silhouettes of the motion, drawn on demand."""

    def __init__(self, body: Body):
        self.body, self.cameras = body, cameras()

    def __call__(self, frame: int) -> Sequence[np.ndarray]:
        """Draw a frame."""
        posed = PosedBody(self.body, pose_at(self.body, frame))
        return [view_of(posed, camera).mask() for camera in self.cameras]


def begun(body: Body, count: int) -> tuple[list[Pose], list[int]]:
    """Return poses near the truth, and the frames that speak of the shape."""
    rng = np.random.default_rng(1)
    start = [pose_at(body, f).step(rng.normal(size=len(body.skeleton)) * 0.01) for f in range(count)]
    return start, np.linspace(0, count - 1, 25).astype(int).tolist()


def grow(table: Table, count: int) -> None:
    """Refine a take of this many frames; time and memory."""
    body = person_body("coarse")
    levels = FrameLevels(cameras(), Seen(body), 1.0)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    began = time.perf_counter()
    start, shape_frames = begun(body, count)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with FrameLog(folder / "rounds.log") as rounds, FrameLog(folder / "windows.log") as parts:
            memory = RefineCheckpoint(KeptArrays(rounds), KeptArrays(parts))
            kept = [
                measure_piece(piece)
                for piece in refine_in_pieces(
                    range(count), start, body, levels, rate=RATE, rounds=ROUNDS, shape_frames=shape_frames,
                    checkpoint=memory,
                )
            ]  # fmt: skip
    seconds = time.perf_counter() - began
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    frames = sum(len(part.frames) for part in kept)
    table.row(str(frames), len(kept), 1e3 * seconds / count / ROUNDS, peak / 1e6, before / 1e6)


def compare(table: Table, count: int = 480) -> None:
    """Refine some frames in one system and in windows; the largest differences."""
    body = person_body("coarse")
    levels = FrameLevels(cameras(), Seen(body), 1.0)
    start, shape_frames = begun(body, count)

    def fit(length: int, overlap: int) -> SequenceFit:
        divided = sequence.windows
        sequence.windows = lambda count, *_: windows(count, length, overlap)
        try:
            return sequence.refine_sequence(
                range(count), start, body, levels, rate=RATE, rounds=ROUNDS, shape_frames=shape_frames
            )
        finally:
            sequence.windows = divided

    whole = fit(count, 0)
    for overlap in (0, 5, 15, 30):
        parts = fit(120, overlap)
        shape_sd = np.sqrt(np.diag(whole.body.numbers_covariance))
        shape = np.abs(parts.body.numbers - whole.body.numbers) / shape_sd
        sd = np.sqrt(np.diagonal(whole.covariance, axis1=1, axis2=2))[:, : len(body.skeleton)]
        steps = np.array([a.change_to(b) for a, b in zip(whole.poses, parts.poses, strict=True)])
        table.row(str(overlap), np.abs(steps / sd).max(), shape.max())


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("frames", nargs="*", type=int, help="lengths of takes (300, 1000 and 3000 without any)")
    parser.add_argument("--compare", action="store_true", help="compare windows with one system instead")


def run(run: Run) -> None:
    """Refine takes."""
    given = run.arguments
    if given.compare:
        columns = (Column("poses differ by at most", "sd", 4), Column("shape differs by at most", "sd", 4))
        compare(run.table("Windows of 120 frames against one system of 480 frames", "neighbouring frames", *columns))
        return
    columns = (
        Column("windows"),
        Column("per frame and round", "ms", 0),
        Column("peak memory", "GB", 2),
        Column("memory before", "GB", 2),
    )
    table = run.table("Refinement of long takes", "frames", *columns)
    for count in given.frames or (300, 1000, 3000):
        grow(table, count)
