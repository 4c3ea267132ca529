"""Pictures of a made session with a board, and their calibration."""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from tests.made_boards import BOARD, FLOOR, MadeSession, made_rig, made_session

import marey
from marey.calibration.boards.printed import own_view, render_board
from marey.io.video.pictures import write_picture
from marey.pipelines.progress import RecordingProgress

DESCRIPTION = {
    "type": "ChArUco", "columns": 9, "rows": 6, "dictionary": "DICT_5X5_250", "square_m": 0.1, "marker_m": 0.075,
}  # fmt: skip


PICTURES = 24
"""Number of pictures per camera; the last one shows the board on the floor."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibratedSession:
    """A session of pictures and what an undisturbed calibration found."""

    made: MadeSession
    folder: Path
    """Of the pictures."""
    found: marey.Calibration
    out: Path
    """Of the results."""
    progress: RecordingProgress


def calibrated(folder: Path) -> CalibratedSession:
    """Write pictures of three cameras below a folder, and calibrate them."""
    rig = made_rig(3, np.random.default_rng(6), radius=2.6)
    made = made_session(rig=rig, pictures=PICTURES, seed=6, floor=1)
    assert made.world_from_board[-1] is FLOOR
    write_session(folder / "session", made)
    out, progress = folder / "out", RecordingProgress()
    # With one thread of OpenCV, as the command does: with more, its sums differ in the last digits.
    with marey.tuned_process():
        found = marey.calibrate(folder / "session", out=out, floor="last", progress=progress)
    return CalibratedSession(made=made, folder=folder / "session", found=found, out=out, progress=progress)


def write_session(folder: Path, session: MadeSession) -> None:
    """Write what the cameras of a made session see, as numbered pictures."""
    folder.mkdir(parents=True)
    (folder / "board.json").write_text(json.dumps(DESCRIPTION))
    rng = np.random.default_rng(1)
    views = set(zip(session.corners.picture.tolist(), session.corners.camera.tolist(), strict=True))
    for picture, pose in enumerate(session.world_from_board):
        for number, camera in enumerate(session.rig):
            if (picture, number) not in views:
                continue
            rendered = render_board(BOARD, own_view(camera), camera.camera_from_world @ pose)
            assert rendered is not None
            ground = np.full((camera.height, camera.width), 110.0)
            x, y = rendered.corner
            height, width = rendered.grey.shape
            ground[y : y + height, x : x + width] = np.where(rendered.on_board, 35 + 180 * rendered.grey, 110.0)
            ground = cv2.GaussianBlur(ground, (0, 0), 0.6) + rng.normal(0, 2, ground.shape)
            image = np.clip(np.round(ground), 0, 255).astype(np.uint8)
            write_picture(folder / f"{camera.name}_{picture:03d}.jpg", image)
