"""Calibrated cameras against the truth: made sets of boards and wands, and the rendered and recorded sessions.

Made corner sets: cameras of 1280 x 720 px around a board that is walked through 4 m x 4 m, corners with independent
errors of 0.1 px, start values with focal lengths 3 % wrong and no distortion. Made wands: three balls, or two that look
alike, and four tags on the floor whose coordinates are exact; nothing is known of the lenses. Late wands: one camera is
late by some pictures, or all but one are; 300 pictures show half of the walk of the other sessions, in which a ball
moves by 37 px per picture on average. The session is calibrated with its delays as unknowns, and, for comparison, as if
all cameras were in step; `delay held` is the share of the delays within 1.96 stated standard deviations. Errors are
those of `score/calibration.py`: rotation and position after the best rigid motion of all cameras. `held` is the share
of errors of focal lengths and principal points within 1.96 stated standard deviations.

World of the floor: the world of the rendered session and of six that are rendered here (six cameras, 30 s, H.264), as
the rigid motion of all cameras against the true ones. `distance` is the square of its Mahalanobis distance, which is 6
in the mean if the stated covariance is exact. Only where it is named.

On the corners of another program: the corners that it found in `charuco`, whose cameras are not exactly in step. Each
corner of a picture that two cameras show or more is placed alone by either program's cameras; the residuals and the
lengths of the sides of squares between such points are compared. The other program placed each corner alone for its
calibration, too, which suits this measure; ours places boards.
"""

import argparse
import csv
from pathlib import Path

import numpy as np
from tests.made_boards import MadeSession, made_session
from tests.made_wands import WAND, MadeWand, made_wand

from bench.common import program
from bench.common.board_videos import make_board_videos
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.calibration.adjustment.landmarks import in_landmark_world
from marey.calibration.adjustment.solve import SolvedSession, refined_session, solve_session
from marey.calibration.adjustment.state import CAMERA, LENS
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.corners import BoardSighting, CornerSet
from marey.calibration.boards.still import join_still
from marey.calibration.boards.wand import CalibrationWand
from marey.calibration.quality.world import centre_slope, centres, find_floor, in_floor_world
from marey.calibration.timing.wand_clocks import solve_wand_videos, stated_delays
from marey.cameras.rig import Rig
from marey.cameras.triangulate import triangulate
from marey.geometry import rotations
from marey.io.calibration.readers import read_rig
from marey.io.calibration.target import read_target
from marey.pipelines.calibrate.run import calibrated_session
from marey.pipelines.calibrate.settings import CalibrationOptions
from marey.pipelines.calibrate.tasks import calibrate
from marey.pipelines.progress import RecordingProgress

BENCH = Bench(
    measures="Cameras calibrated from boards: made corner sets against the truth, rendered and recorded sessions.",
    sources=("src/marey/calibration", "src/marey/pipelines/calibrate"),
    minutes=12,
)
SETUPS = ((4, 600, 0), (4, 600, 1), (6, 600, 2), (8, 600, 3))
"""Cameras, pictures and seed of the made sessions."""
LATE = (
    ("none", (0.0,)),
    ("one", (0.0, 0.3)),
    ("one", (0.0, 0.0, 1.5)),
    ("one", (12.0,)),
    ("all", (0.0, 0.4, -1.3, 20.7)),
)
"""Which cameras are late in the sessions with late wands, and by how many pictures; others are on time."""
LATE_SEEDS = (20, 21)
"""Their seeds; none of them chose a threshold."""
TWO_BALLS = CalibrationWand(distances=(0.5,))
"""A wand of two balls that look alike."""
IN_STEP = LATE[1:4:2]
"""Late sessions of the first seed and three balls that are also calibrated as if all cameras were in step."""
SESSIONS = ("boards4", "charuco", "boards3", "checkerboards")
FLOOR_SEEDS, FLOOR_CAMERAS, FLOOR_SECONDS = range(11, 17), 6, 30.0
"""Seeds, cameras and length of the sessions that are rendered with a board on the floor."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "parts", nargs="*", help="made, wands, late, other, names of sessions, or floor; all but floor without"
    )


def run(run: Run) -> None:
    """Calibrate and compare."""
    parts = run.arguments.parts or ["made", "wands", "late", "other", *SESSIONS]
    if "made" in parts:
        made(run)
    if "wands" in parts:
        wands(run)
    if "late" in parts:
        late(run)
    if "other" in parts:
        other_program(run)
    if "floor" in parts:
        floors(run)
    sessions = [name for name in SESSIONS if name in parts]
    if sessions:
        recorded(run, sessions)


def made(run: Run) -> None:
    """Solve made corner sets."""
    table = run.table(
        "Made corner sets", ("cameras", "pictures", "seed"),
        Column("rotation", "deg", 4), Column("position", "mm", 2), Column("focal length, worst", "%", 4),
        Column("held", "%", 0),
    )  # fmt: skip
    for count, pictures, seed in SETUPS:
        session = made_session(cameras=count, pictures=pictures, seed=seed)
        table.row((str(count), str(pictures), str(seed)), *errors(session, solved_from_rough_start(session)))


def wands(run: Run) -> None:
    """Solve made sets of points of a wand and of tags on the floor, without start values."""
    table = run.table(
        "Made wands and four floor tags", ("balls", "cameras", "pictures", "seed"),
        Column("rotation", "deg", 4), Column("position", "mm", 2), Column("focal length, worst", "%", 4),
        Column("held", "%", 0),
    )  # fmt: skip
    for wand in (WAND, TWO_BALLS):
        for count, pictures, seed in SETUPS:
            session = made_wand(cameras=count, pictures=pictures, seed=seed, wand=wand)
            pixels = {key: (pixel, 0.01 * np.eye(2)) for key, pixel in session.seen.items()}
            found = in_landmark_world(solve_session(session.corners, wand), session.landmarks, pixels)
            assert found is not None
            row = (str(len(wand.points)), str(count), str(pictures), str(seed))
            table.row(row, *errors(session, found.solved))


def late(run: Run) -> None:
    """Solve made sets of points of a wand by cameras that are late."""
    labels = ("late", "delays", "balls", "seed")
    columns = (
        Column("rotation", "deg", 4), Column("position", "mm", 2), Column("focal length, worst", "%", 4),
        Column("held", "%", 0),
    )  # fmt: skip
    table = run.table(
        "Late wands", labels, *columns, Column("delay, worst", "pictures", 5), Column("sd, worst", "pictures", 5),
        Column("delay held", "%", 0), Column("used wrongly", "", 0),
    )  # fmt: skip
    for wand in (WAND, TWO_BALLS):
        for seed in LATE_SEEDS if wand is WAND else LATE_SEEDS[:1]:
            for which, delays in LATE:
                session = late_session(wand, seed, delays)
                solved, clocks = solve_wand_videos(session.corners, wand)
                world = in_tag_world(session, solved)
                stated = stated_delays(clocks, world)
                true = np.array([*delays, 0.0, 0.0, 0.0])[:4]
                off = np.array([each.pictures - true[each.camera] + true[clocks.reference] for each in stated])
                sd = np.array([each.sd for each in stated])
                wrong = sum(each.used and true[each.camera] == true[clocks.reference] for each in stated)
                table.row(
                    late_label(which, delays, wand, seed), *errors(session, world), float(np.abs(off).max()),
                    float(sd.max()), float(100 * np.mean(np.abs(off) < 1.96 * sd)), wrong,
                )  # fmt: skip
    plain = run.table("Late wands as if in step", labels, *columns, Column("views left out", "", 0))
    for which, delays in IN_STEP:
        session = late_session(WAND, LATE_SEEDS[0], delays)
        solved = solve_session(session.corners, WAND)
        world = in_tag_world(session, solved)
        plain.row(late_label(which, delays, WAND, LATE_SEEDS[0]), *errors(session, world), len(solved.left_out))


def late_session(wand: CalibrationWand, seed: int, delays: tuple[float, ...]) -> MadeWand:
    """A made session of four cameras that are late."""
    return made_wand(cameras=4, pictures=300, seed=seed, wand=wand, late=(*delays, 0.0, 0.0, 0.0)[:4], pace=0.5)


def late_label(which: str, delays: tuple[float, ...], wand: CalibrationWand, seed: int) -> tuple[str, ...]:
    """The labels of a row."""
    return which, " ".join(f"{each:g}" for each in delays if each) or "0", str(len(wand.points)), str(seed)


def in_tag_world(session: MadeWand, solved: SolvedSession) -> SolvedSession:
    """Bring a session to the world of its tags, or leave it where they do not determine one."""
    pixels = {key: (pixel, 0.01 * np.eye(2)) for key, pixel in session.seen.items()}
    found = in_landmark_world(solved, session.landmarks, pixels)
    return solved if found is None else found.solved


def solved_from_rough_start(session: MadeSession) -> SolvedSession:
    """Solve a made session from focal lengths that are 3 % wrong."""
    lenses = true_lenses(session)
    lenses[:, :2] *= 1.03
    lenses[:, 4:] = 0.0
    still = join_still(session.corners)
    solved = solve_session(still.corners, session.board, lenses=lenses)
    floor = find_floor(solved, still)
    return solved if floor is None else in_floor_world(solved, floor)


def true_lenses(session: MadeSession | MadeWand) -> np.ndarray:
    """The true lenses (C, 9)."""
    return np.array(
        [[c.matrix[0, 0], c.matrix[1, 1], c.matrix[0, 2], c.matrix[1, 2], *c.distortion, 0.0] for c in session.rig]
    )


def errors(session: MadeSession | MadeWand, solved: SolvedSession) -> tuple[float, ...]:
    """Rotation [deg], position [mm], worst focal length [%] and share of errors within their intervals [%]."""
    own, true = centres(solved.state), session.rig.centres
    turns = np.stack([camera.camera_from_world.rotation for camera in session.rig])
    scale = np.ptp(true, axis=0).max()
    both = np.einsum("cji,cjk->ik", turns, solved.state.camera_rotation) * scale**2
    both += (true - true.mean(0)).T @ (own - own.mean(0))
    turn = rotations.nearest(both)
    shift = own @ turn.T - own.mean(0) @ turn.T + true.mean(0) - true
    angle = [
        np.degrees(np.linalg.norm(rotations.log(a @ turn.T @ b.T)))
        for a, b in zip(solved.state.camera_rotation, turns, strict=True)
    ]
    off = (solved.state.lens - true_lenses(session))[:, :4]
    sd = np.sqrt(np.diag(solved.covariance))[: CAMERA * len(turns)].reshape(-1, CAMERA)[:, :4]
    focal = 100 * np.abs(off[:, :2] / solved.state.lens[:, :2]).max()
    return (
        float(np.sqrt(np.mean(np.square(angle)))), float(1e3 * np.sqrt(np.mean(np.sum(shift**2, 1)))), float(focal),
        float(100 * np.mean(np.abs(off) < 1.96 * sd)),
    )  # fmt: skip


def recorded(run: Run, names: list[str]) -> None:
    """Calibrate the sessions of data/calibration."""
    table = run.table(
        "Sessions", ("session", "camera"), Column("pictures", "", 0), Column("RMS residual", "px", 3),
        Column("median residual", "px", 3), Column("focal length", "px", 1), Column("sd", "px", 2),
    )  # fmt: skip
    truth = run.table(
        "Rendered session against the truth", "session", Column("rotation", "deg", 4), Column("position", "mm", 2),
        Column("focal length", "%", 3), Column("volume", "mm", 2), Column("world", "mm", 2), Column("world", "deg", 4),
    )  # fmt: skip
    for name in names:
        folder = run.shared / "data" / "calibration" / name
        out = run.out / "calibration" / name
        found = calibrate(folder, out=out)
        for camera, each in found.data["cameras"].items():
            lens = each["lens"]["fx"]
            table.row((name, camera), each["pictures"], each["rms_px"], each["median_px"], lens["value"], lens["sd"])
        true = folder / "truth" / "cameras.toml"
        if true.is_file():
            score = program.score(run, "calibration.py", Path(out) / "cameras.toml", true)
            keys = ("rotation_deg", "position_mm", "focal_percent", "volume_mm", "world_mm", "world_deg")
            truth.row(name, *(score[key] for key in keys))


def other_program(run: Run) -> None:
    """Compare both programs' cameras on the corners of the other one."""
    table = run.table(
        "On the corners of another program", ("session", "cameras of"), Column("points", "", 0),
        Column("RMS residual", "px", 3), Column("median residual", "px", 3), Column("RMS error of a side", "mm", 3),
        Column("mean side", "mm", 2),
    )  # fmt: skip
    folder = run.shared / "data" / "calibration" / "charuco"
    given = read_rig(folder / "reference_cameras.toml")
    target = read_target(folder / "board.json", None, lambda path, up: {})
    board = target.moved
    assert isinstance(board, CalibrationBoard)
    corners = corners_of(folder / "reference_corners.csv", given)
    solved = refined_session(solve_session(corners, board), corners)
    own = solved.state.rig(given.names, [camera.size for camera in given])
    for name, rig in (("the other program", given), ("marey", own)):
        residual, sides = placed_alone(rig, corners, board)
        wrong = 1e3 * (sides - board.square)
        table.row(
            ("charuco", name), len(residual), np.sqrt(np.mean(residual**2)), np.median(residual),
            np.sqrt(np.mean(wrong**2)), 1e3 * sides.mean(),
        )  # fmt: skip


def corners_of(path: Path, rig: Rig) -> CornerSet:
    """Read the corners of another program, with equal standard deviations."""
    views: dict[tuple[int, int], list[tuple[int, float, float]]] = {}
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            view = int(row["frame"]), rig.names.index(row["camera"])
            views.setdefault(view, []).append((int(row["corner"]), float(row["x_px"]), float(row["y_px"])))
    frames = sorted({frame for frame, _ in views})
    sightings = []
    for (frame, camera), found in sorted(views.items()):
        values = np.array(sorted(found))
        spread = np.broadcast_to(0.01 * np.eye(2), (len(values), 2, 2))
        sighting = BoardSighting(corner=values[:, 0].astype(int), pixels=values[:, 1:], covariance=spread)
        sightings.append((frames.index(frame), camera, sighting))
    return CornerSet.gather(rig.names, tuple(camera.size for camera in rig), tuple(map(str, frames)), sightings)


def placed_alone(rig: Rig, corners: CornerSet, board: CalibrationBoard) -> tuple[np.ndarray, np.ndarray]:
    """Residuals [px] of corners that are triangulated one by one, and the sides of squares between them [m]."""
    count, columns = len(board.points), board.columns - 1
    pixels = np.full((len(rig), len(corners.pictures) * count, 2), np.nan)
    pixels[corners.camera, corners.picture * count + corners.corner] = corners.pixels
    pixels[:, np.isfinite(pixels[..., 0]).sum(axis=0) < 2] = np.nan
    points = triangulate(list(rig), pixels, sigma_px=1.0).points
    apart = np.stack([camera.project(points) for camera in rig]) - pixels
    places = points.reshape(-1, count // columns, columns, 3)
    sides = [np.linalg.norm(np.diff(places, axis=axis), axis=-1).ravel() for axis in (1, 2)]
    lengths, residual = np.concatenate(sides), np.linalg.norm(apart, axis=-1)
    return residual[np.isfinite(residual)], lengths[np.isfinite(lengths)]


def floors(run: Run) -> None:
    """Compare the worlds of boards on the floor with the true ones."""
    table = run.table(
        "World of the floor", "session", Column("origin", "mm", 3), Column("stated sd", "mm", 3),
        Column("axes", "deg", 4), Column("stated sd", "deg", 4), Column("distance", "", 1),
    )  # fmt: skip
    given = run.shared / "data" / "calibration" / "boards4"
    sessions = [("boards4", given, given / "truth" / "cameras.toml")]
    for seed in FLOOR_SEEDS:
        place = run.out / "floor" / str(seed)
        made = make_board_videos(place, cameras=FLOOR_CAMERAS, seconds=FLOOR_SECONDS, seed=seed)
        sessions.append((f"seed {seed}", made.folder, made.truth))
    for name, folder, truth in sessions:
        options = CalibrationOptions(out=run.out / "floor" / f"{name} calibrated")
        with calibrated_session(folder, options, RecordingProgress()) as found:
            pass
        off, spread = world_error(found.solved, read_rig(truth))
        sd = np.sqrt(np.diag(spread))
        table.row(
            name, *(1e3 * np.linalg.norm(x[3:]) for x in (off, sd)),
            *(np.degrees(np.linalg.norm(x[:3])) for x in (off, sd)), off @ np.linalg.solve(spread, off),
        )  # fmt: skip


def world_error(solved: SolvedSession, true: Rig) -> tuple[np.ndarray, np.ndarray]:
    """The rigid motion (6,) [rad, m] of all cameras from the true ones, and its stated covariance."""
    state, size = solved.state, len(solved.covariance)
    motion, metric, off = np.zeros((size, 6)), np.zeros((6 * state.cameras, size)), np.zeros(size)
    scale = float(np.ptp(centres(state), axis=0).max())
    for camera, name in enumerate(solved.corners.cameras):
        start, turn = CAMERA * camera + LENS, state.camera_rotation[camera]
        motion[start : start + 3, :3] = motion[start + 3 : start + 6, 3:] = -turn
        metric[6 * camera : 6 * camera + 3, start : start + 3] = scale * np.eye(3)
        metric[6 * camera + 3 : 6 * camera + 6, start : start + 6] = centre_slope(state, camera)
        pose = true[name].camera_from_world
        off[start : start + 3] = rotations.log(turn @ pose.rotation.T)
        off[start + 3 : start + 6] = state.camera_translation[camera] - pose.translation
    weight = metric.T @ metric
    found = np.linalg.solve(motion.T @ weight @ motion, motion.T @ weight)
    return found @ off, found @ solved.covariance @ found.T
