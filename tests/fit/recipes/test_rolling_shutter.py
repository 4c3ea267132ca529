"""A fast motion before cameras whose rows are exposed one after the other."""

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.fit.recipes.sequence import refine_sequence
from marey.fit.search.levels import FrameLevels
from marey.fit.solver.picture_times import PictureRows, PictureTimes

READOUT = 0.6
"""Time from the first row to the last one: 20 ms at 30 Hz [frames]."""
CAMERAS = worlds.ring(3)
FRAMES = range(7)
BANDS = 15
"""Groups of rows that are drawn at one instant; within each, the hand moves by 1 px at most."""


def motion(instant):
    """Limbs swing with a period of half a second, about the fastest of jumping jacks."""
    phase = 2 * np.pi * instant / 14
    degrees = dict(worlds.ARMS_AND_KNEES)
    for name, width in {"left_shoulder_lift": 35, "right_hip_flexion": 30, "left_elbow_flexion": 25}.items():
        degrees[name] = degrees.get(name, 0.0) + width * np.sin(phase)
    at = 0.15 * np.sin(phase), 0.05 * instant, 0.02 * np.sin(2 * phase)
    return worlds.pose(worlds.scan(), degrees, yaw=0.3 * np.sin(phase), at=at)


def picture(camera, frame, readout):
    """The silhouette whose rows show the instants at which they are exposed."""
    mask = np.zeros((camera.height, camera.width), bool)
    for rows in np.array_split(np.arange(camera.height), BANDS if readout else 1):
        instant = frame + readout * (rows.mean() / (camera.height - 1) - 0.5)
        mask[rows] = worlds.silhouettes(PosedBody(worlds.scan(), motion(instant)), [camera])[0][rows]
    return mask


def joint_error(masks, times):
    """Root mean square of the joints' errors in the inner frames [m]."""
    body, rng = worlds.scan(), np.random.default_rng(0)
    start = [motion(f).step(rng.normal(size=len(body.skeleton)) * 0.01) for f in FRAMES]
    levels = FrameLevels(CAMERAS, lambda frame: masks[frame], 1.0)
    fit = refine_sequence(list(FRAMES), start, body, levels, rate=worlds.RATE, rounds=4, times=times)
    pairs = ((PosedBody(body, fit.poses[f]), PosedBody(body, motion(f))) for f in FRAMES[1:-1])
    return float(np.sqrt(np.mean(np.square([worlds.joint_errors(*pair) for pair in pairs]))))


@pytest.mark.slow
def test_a_rolling_shutter_costs_nothing_if_its_readout_is_known():
    rolled = [[picture(camera, f, READOUT) for camera in CAMERAS] for f in FRAMES]
    together = [[picture(camera, f, 0.0) for camera in CAMERAS] for f in FRAMES]
    count = len(CAMERAS)
    rows = PictureRows(cameras=CAMERAS, readout=np.full(count, READOUT), sides=("top",) * count)
    known = joint_error(rolled, PictureTimes(np.zeros((count, len(FRAMES))), rows))
    # The silhouettes are rounded to pixels of 10 mm, and the rows to bands: 1 mm is a tenth of a pixel.
    assert known < joint_error(together, None) + 1e-3
    assert joint_error(rolled, None) > 4 * known
