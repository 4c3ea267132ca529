"""Faults planted one at a time into made calibration sessions: whether `marey calibrate` names them.

Cameras of 1280 x 720 px see a board that is carried through 4 m x 4 m, brought into the corners of each image and laid
on the floor; corners have errors of 0.1 px. The corners, not pictures, are made: what depends on pictures (other
dictionaries, mirrored pictures) is not part of this benchmark. A fault is `named` if a finding has its code and states
the camera or picture at fault, and `first` if no finding comes before it. `other` counts all further findings, notes
included. Clean sessions should have no finding at all. Sessions with a wand also have several clocks at once. The
thresholds were chosen with the seeds 0 to 5.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from bench.common.fault_list import FAULTS, Fault, Planted, late_wands
from bench.common.fault_sessions import RATE, clean_filming, filmed
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.arrays import Floats, Integers
from marey.calibration.adjustment.landmarks import in_landmark_world
from marey.calibration.adjustment.solve import SolvedSession, recorded_together, refined_session, solve_session
from marey.calibration.adjustment.start import start_lenses
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.corners import CornerSet
from marey.calibration.boards.still import StillGroups, join_still
from marey.calibration.quality.causes import Cause
from marey.calibration.quality.delays import CameraDelay, find_delays, named_delays, without_delays
from marey.calibration.quality.finding import Examined, Finding
from marey.calibration.quality.findings import examine
from marey.calibration.quality.screening import Screening, cause_of_wand, screened
from marey.calibration.quality.settling import settled_session
from marey.calibration.quality.views import camera_quality, view_quality
from marey.calibration.quality.world import find_floor, in_floor_world, in_level_world
from marey.calibration.timing.wand_clocks import WandClocks, solve_wand_videos, stated_delays

BENCH = Bench(
    measures="Faults planted one at a time into made calibration sessions: named, first, and false findings.",
    sources=("src/marey/calibration",),
    minutes=12,
    data=False,
)
HELD_OUT = (11, 3)
"""Seed and number of cameras of the sessions with faults; none of them chose a threshold."""
CLEAN = ((0, 4), (1, 3), (11, 3), (12, 5), (23, 3), (24, 4), (25, 5))
"""Seeds and numbers of cameras of the clean sessions."""
SLOW, FAST, FOUR = 0.01, -0.006, 4
"""Drifts of two cameras [pictures per picture], and the number of cameras of most sessions with several faults."""
SEVERAL: tuple[tuple[int, int, dict[int, float]], ...] = (
    (20, FOUR, {1: SLOW, 2: FAST}), (21, FOUR, {0: -3, 3: SLOW}), (22, FOUR, {1: -2, 2: -4}),
    (23, FOUR, {2: SLOW, 3: SLOW}), (24, 5, {0: -2, 2: -3, 4: SLOW}), (25, FOUR, {}), (26, 3, {}),
)  # fmt: skip
"""Seed, cameras and clocks of sessions with a wand: a part of a picture per picture, or a whole number of pictures that
a camera lost or inserted. None chose a threshold."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--seed", type=int, default=HELD_OUT[0], help="of the sessions with faults")
    parser.add_argument("--cameras", type=int, default=HELD_OUT[1])
    parser.add_argument("--only", default="", help="faults whose name contains this")


def run(run: Run) -> None:
    """Plant and examine."""
    table = run.table(
        "Planted faults", ("fault", "finding"), Column("named"), Column("first"), Column("other findings", "", 0)
    )
    filming = clean_filming(run.arguments.seed, run.arguments.cameras)
    for fault in FAULTS:
        if run.arguments.only in fault.name:
            table.row((fault.name, fault.code), *judged(fault, fault.plant(filming)))
    if run.arguments.only:
        return
    several(run)
    clean = run.table("Clean sessions", ("seed", "cameras"), Column("findings", "", 0), Column("which"))
    for seed, cameras in CLEAN:
        found = findings_of(Planted(corners=filmed(clean_filming(seed, cameras))))
        clean.row((str(seed), str(cameras)), len(found), ", ".join(each.code for each in found) or "none")


def several(run: Run) -> None:
    """Plant the clocks of several cameras at once into sessions with a wand."""
    table = run.table(
        "Several clocks, with a wand", ("seed", "cameras", "faults"), Column("named"), Column("named wrongly", "", 0),
        Column("other findings", "", 0),
    )  # fmt: skip
    for seed, cameras, faults in SEVERAL:
        late = {camera: _clock(size, 0.4 + 0.1 * camera) for camera, size in faults.items()}
        filming = clean_filming(seed, cameras)
        found = findings_of(late_wands(filming, late))
        true = {(_code(size), filming.rig.names[camera]) for camera, size in faults.items()}
        clocks = [each for each in found if each.code in ("clock-drift", "pictures-lost")]
        named = {(code, name) for code, name in true if any(code == e.code and name in e.text for e in clocks)}
        words = ", ".join(f"{100 * size:g} %" if isinstance(size, float) else f"{size:+d}" for size in faults.values())
        table.row(
            (str(seed), str(cameras), words or "none"), f"{len(named)} of {len(true)}", len(clocks) - len(named),
            len(found) - len(clocks),
        )  # fmt: skip


def _code(size: float) -> str:
    return "clock-drift" if isinstance(size, float) else "pictures-lost"


def _clock(size: float, begin: float) -> Callable[[Integers], Floats]:
    """Return the delay of a camera in each picture: a drift, or a number of pictures from a share of the session on."""
    if isinstance(size, float):
        return lambda picture: size * picture
    return lambda picture: np.where(picture >= begin * len(picture), float(size), 0.0)


def judged(fault: Fault, planted: Planted) -> tuple[str, str, int]:
    """Return whether a fault is named, whether it is named first, and the number of other findings."""
    found = findings_of(planted)
    own = [
        each
        for each in found
        if each.code == fault.code and all(part in each.text + each.advice for part in planted.named)
    ]
    first = bool(own) and found[0] in own
    return "yes" if own else "no", "yes" if first else "no", len([each for each in found if each.code != fault.code])


def findings_of(planted: Planted) -> tuple[Finding, ...]:
    """Calibrate and examine a session as `marey calibrate` does from the corners on."""
    clocks: WandClocks | None = None
    if isinstance(planted.board, CalibrationBoard):
        solved, still, cause, delays, together = _of_board(planted.corners, planted.board)
        causes = [] if cause is None else [cause]
    else:
        solved, clocks = solve_wand_videos(planted.corners, planted.board)
        causes = [cause_of_wand(each) for each in clocks.faults]
        delays, together = (), True
        still = StillGroups(corners=solved.corners, first=np.arange(len(solved.corners.pictures)))
    corners, floor, world = still.corners, None, None
    if planted.landmarks:
        world = in_landmark_world(solved, planted.landmarks, planted.pixels)
        assert world is not None
        solved, corners = world.solved, replace(corners, pictures=world.solved.corners.pictures)
    elif together:
        floor = find_floor(solved, still) if planted.floor == "auto" else int(planted.floor)
        solved = in_level_world(solved) if floor is None else in_floor_world(solved, floor)
    views = view_quality(solved)
    return examine(
        Examined(
            solved=solved, corners=corners, views=views, cameras=camera_quality(solved, views),
            floor=floor is not None or world is not None, together=together, distances=planted.distances,
            landmarks=world, late=named_delays(corners, delays), rate=RATE,
            cause=causes[0] if causes else None, further=tuple(causes[1:]),
            delays=() if clocks is None else stated_delays(clocks, solved),
            still=still.first if world is None else None,
        )
    )  # fmt: skip


def _of_board(
    detected: CornerSet, board: CalibrationBoard
) -> tuple[SolvedSession, StillGroups, Cause | None, tuple[CameraDelay, ...], bool]:
    lenses = start_lenses(detected, board)
    delays = find_delays(detected, board, lenses)
    detected = without_delays(detected, delays)
    together = recorded_together(detected, board, lenses)
    screening = screened(detected, board, lenses, videos=True) if together else Screening()
    detected = screening.retimed(detected)
    if screening.cameras:
        detected = screening.kept(detected)
        lenses = start_lenses(detected, board)
    still = join_still(detected) if together else join_still(detected.separated())
    solved, cause = solve_session(still.corners, board, lenses=lenses, model=not together), None
    if together:
        refined = refined_session(solved, still.corners)
        settled = settled_session(refined, still.corners, videos=True, screening=screening, still=still.first)
        solved, cause = settled.solved, settled.cause
    return solved, still, cause, delays, together
