"""Takes captured with cameras that were calibrated from made board sessions, instead of the true cameras.

A board is carried through the room before the cameras of each take; its corners have independent errors and are made,
without images. The session is calibrated from focal lengths 3 % wrong, and the board on the floor defines the world.
`cameras.toml` and the covariance in `calibration.json` replace the true cameras of the take. Errors of the cameras are
those after the best rigid motion of all of them. `without` has the intervals that leave out the uncertainty of the
cameras (`camera_uncertainty=False`): the same capture otherwise. Intervals are scored without the constant offset of
each joint, in the frame of its limb (`own_covered_95`).
"""

import argparse
import json
from pathlib import Path

import numpy as np
from tests.made_boards import BOARD, MadeSession, made_session, walked

import marey
from bench.capture.calibration import errors, solved_from_rough_start
from bench.common.program import capture, empty_frames, score, take, truth_of
from bench.common.sabotaged_takes import TakeCopy
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.calibration.adjustment.solve import SolvedSession
from marey.cameras.parameters import PARAMETERS
from marey.io.calibration.covariance import COVARIANCE_FILE
from marey.io.calibration.readers import write_cameras_toml
from marey.pipelines.from_person.refined_cameras import CAMERAS_FILE, person_content

BENCH = Bench(
    measures="Joints and their intervals with cameras that were calibrated from made boards, not with the true ones.",
    sources=("src/marey/calibration", "src/marey/fit", "src/marey/pipelines/capture"),
    minutes=15,
)
TAKES = ("walk", "reach", "stealth", "jacks")
SESSIONS = {"usual": (150, 0.1, 12), "poor": (24, 0.5, 4)}
"""Number of pictures, standard deviation of the corners [px], and number of pictures of the board on the floor."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("takes", nargs="*", help=f"of {', '.join(TAKES)}; all without")


def run(run: Run) -> None:
    """Capture each take with the cameras of each session."""
    table = run.table(
        "Takes with own cameras", ("take", "session"), Column("rotation", "deg", 3), Column("position", "mm", 2),
        Column("focal length, worst", "%", 3), Column("joints", "mm", 1), Column("95 % intervals hold", "", 3),
        Column("without", "", 3), Column("joints, true cameras", "mm", 1), Column("hold, true cameras", "", 3),
    )  # fmt: skip
    for number, name in enumerate(run.arguments.takes or TAKES):
        trial, known = take(run, name)
        for kind, (pictures, noise, floor) in SESSIONS.items():
            session = session_of(trial, pictures=pictures, noise=noise, floor=floor, seed=number)
            solved = solved_from_rough_start(session)
            copy = TakeCopy.of(trial, run.out / "own" / f"{name} {kind}")
            write_cameras(copy.folder, session, solved)
            own = capture(copy.folder, copy.folder / "results")
            plain = capture(copy.folder, copy.folder / "without", camera_uncertainty=False)
            found = [
                score(run, "capture.py", each, truth_of(trial), "--skip-empty", empty_frames(trial))
                for each in (own, plain, known)
            ]
            table.row(
                (name, kind), *errors(session, solved)[:3], found[0]["joint_mm"], found[0]["own_covered_95"],
                found[1]["own_covered_95"], found[2]["joint_mm"], found[2]["own_covered_95"],
            )


def session_of(trial: Path, *, pictures: int, noise: float, floor: int, seed: int) -> MadeSession:
    """A session of a board before the cameras of a take; the board on the floor lies in the axes of its world."""
    poses = walked(pictures, np.random.default_rng(seed), BOARD, floor=floor)
    return made_session(rig=marey.read_cameras(trial), poses=poses, noise=noise, seed=seed)


def write_cameras(folder: Path, session: MadeSession, solved: SolvedSession) -> None:
    """Write the calibrated cameras and their covariance to the folder of a take."""
    rig = solved.state.rig(session.rig.names, [camera.size for camera in session.rig])
    write_cameras_toml(rig, folder / CAMERAS_FILE)
    size = PARAMETERS * len(rig)
    content = person_content(
        rig, solved.covariance[:size, :size], [""] * len(rig), [], source="board", world="that of the board"
    )
    (folder / COVARIANCE_FILE).write_text(json.dumps(content), encoding="utf-8")
