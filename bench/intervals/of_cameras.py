"""Calibrated cameras: lenses, rotations and positions of made sessions of boards and of wands."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from tests.made_boards import MadeSession, made_session
from tests.made_wands import MadeWand, made_wand

from bench.capture.calibration import solved_from_rough_start, true_lenses
from bench.intervals.scoring import Sample, sample, single
from bench.recording import Run
from marey.calibration.adjustment.landmarks import in_landmark_world
from marey.calibration.adjustment.solve import SolvedSession, solve_session
from marey.calibration.adjustment.state import CAMERA, LENS
from marey.calibration.quality.world import centre_slope, centres
from marey.geometry import rotations

BOARDS = tuple((cameras, 150, seed) for cameras in (3, 4, 6) for seed in (40, 41, 42))
"""Cameras, pictures and seed of the sessions of boards."""
WANDS = tuple((4, 200, seed) for seed in (50, 51, 52))
"""The same of the sessions of wands of three balls, with tags on the floor that determine the world."""
TAG_SD_M = 1e-3
"""Errors of the given coordinates of the tags, as they are stated."""


def samples(run: Run) -> Iterator[Sample]:
    """Calibrate made sessions, without start values or from rough ones."""
    for cameras, pictures, seed in BOARDS:
        session = made_session(cameras=cameras, pictures=pictures, seed=seed)
        solved = solved_from_rough_start(session)
        yield from of_cameras("boards", f"{cameras} cameras, seed {seed}", session, solved)
    for cameras, pictures, seed in WANDS:
        wand = made_wand(cameras=cameras, pictures=pictures, seed=seed)
        pixels = {key: (pixel, 0.01 * np.eye(2)) for key, pixel in wand.seen.items()}
        rng = np.random.default_rng(seed)
        given = [replace(each, place=tuple(each.place + rng.normal(0, TAG_SD_M, 3))) for each in wand.landmarks]
        found = in_landmark_world(solve_session(wand.corners, wand.wand), tuple(given), pixels)
        if found is not None:
            yield from of_cameras("wands", f"{cameras} cameras, seed {seed}", wand, found.solved)


def of_cameras(what: str, case: str, session: MadeSession | MadeWand, solved: SolvedSession) -> Iterator[Sample]:
    """Compare the cameras of a session, in the world of its floor, with the true ones."""
    state, count = solved.state, solved.state.cameras
    own = solved.covariance[: CAMERA * count, : CAMERA * count].reshape(count, CAMERA, count, CAMERA)
    blocks = own[np.arange(count), :, np.arange(count)]
    sd = np.sqrt(np.maximum(np.diagonal(blocks, axis1=1, axis2=2), 0.0))
    off = state.lens - true_lenses(session)
    yield single(f"focal lengths and principal points, {what}", case, "px", off[:, :4], sd[:, :4])
    yield single(f"distortion coefficients, {what}", case, "1", off[:, 4:8], sd[:, 4:8])
    turns = np.stack([camera.camera_from_world.rotation for camera in session.rig])
    turn = rotations.log(state.camera_rotation @ np.swapaxes(turns, 1, 2))
    yield sample(
        f"rotations, {what}", case, "deg", np.degrees(turn), np.degrees(sd[:, LENS : LENS + 3])
    )  # fmt: skip
    slopes = np.stack([centre_slope(state, camera) for camera in range(count)])
    spread = slopes @ blocks[:, LENS:, LENS:] @ np.swapaxes(slopes, 1, 2)
    place_sd = np.sqrt(np.maximum(np.diagonal(spread, axis1=1, axis2=2), 0.0))
    yield sample(f"positions, {what}", case, "mm", 1e3 * (centres(state) - session.rig.centres), 1e3 * place_sd)
