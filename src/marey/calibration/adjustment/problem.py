"""The least-squares problem of a session: which unknowns are free, and what is known of them beforehand."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.calibration.adjustment.adjust import AdjustmentProblem, free_unknowns
from marey.calibration.adjustment.state import CAMERA, LENS, LENS_NAMES, SHAPE, SessionState
from marey.calibration.boards.corners import CornerSet
from marey.calibration.boards.wand import CalibrationTarget

_CENTRE_SD = 0.05
"""Standard deviation of the principal point about the middle of the image, in widths of the image; chosen by hand."""
_ASPECT_SD = 3e-3
"""Standard deviation of the difference of the focal lengths, in widths of the image: pixels are square. By hand."""
_LENS_SD = {"k1": 0.5, "k2": 0.5, "p1": 0.01, "p2": 0.01, "k3": 0.5}
"""Standard deviations of the distortion coefficients about zero; chosen by hand, wider than the lenses of the data."""
_SHAPE_SD = (2e-3, 0.03, 0.03, 0.03)
"""Standard deviations of the board's stretch, and of its bends [1/m]; chosen by hand: a bad print on thin card."""

_DELAY_SD = 1.0
"""Standard deviation of the delay of a camera from that to which its corners were interpolated [pictures]; by hand:
the equations are linear in it, and whole pictures are found before."""


def without_extras(state: SessionState) -> SessionState:
    """Return the state with lenses without k3 and an ideal board."""
    lens = np.array(state.lens)
    lens[:, LENS_NAMES.index("k3")] = 0.0
    return replace(state, lens=lens, shape=np.zeros(SHAPE))


def with_lenses(problem: AdjustmentProblem, lens: Mask, omitted: Floats | None = None) -> AdjustmentProblem:
    """Return a problem with other models of the lenses.

    Args:
        problem: The problem.
        lens: (C, 9) parameters that are estimated.
        omitted: (C, 9, 9) expected products of the distortion coefficients that are not; zero by default.
    """
    free = problem.free.copy()
    free[: CAMERA * len(lens)].reshape(-1, CAMERA)[:, :LENS] = lens
    return replace(problem, free=free, omitted=np.zeros_like(problem.omitted) if omitted is None else omitted)


def without_coefficients(state: SessionState, lens: Mask) -> SessionState:
    """Return the state with distortion coefficients of zero where they are not estimated.

    Args:
        state: The state.
        lens: (C, 9) parameters of the lenses that are estimated.
    """
    distortion = np.arange(LENS) >= LENS_NAMES.index("k1")
    return replace(state, lens=np.where(distortion & ~lens, 0.0, state.lens))


def default_lens(corners: CornerSet) -> Mask:
    """Return the lens parameters (C, 9) without k3; none of a camera that never saw the board."""
    lens = np.ones((len(corners.cameras), LENS), bool)
    lens[:, LENS_NAMES.index("k3")] = False
    lens[~np.isin(np.arange(len(lens)), corners.camera)] = False
    return lens


def session_problem(
    corners: CornerSet, board: CalibrationTarget, lens: Mask, joined: Integers, *, shape: bool
) -> AdjustmentProblem:
    """Set the problem up; the first camera of each group of connected cameras keeps its pose."""
    count = len(corners.cameras)
    free = free_unknowns(count, lens=lens, first_pose=True, shape=shape, delay=timed_cameras(corners))
    for camera in _anchors(corners, joined):
        free[CAMERA * camera + LENS : CAMERA * (camera + 1)] = False
    mean, sd = lens_priors(corners.sizes)
    aspect = _ASPECT_SD * np.array([max(size) for size in corners.sizes], float)
    return AdjustmentProblem(
        corners=corners, board=board, pose=np.arange(len(corners.pictures)), free=free, prior_mean=mean, prior_sd=sd,
        aspect_sd=aspect, fixed_pose=np.zeros(len(corners.pictures), bool),
        place_mean=np.zeros((len(corners.pictures), 3)), place_sd=np.full(len(corners.pictures), np.inf),
        omitted=np.zeros((count, LENS, LENS)),
    )  # fmt: skip


def _anchors(corners: CornerSet, joined: Integers) -> list[int]:
    """Return the cameras that keep their poses: the best seen of each group, and those that see nothing."""
    seen = np.bincount(corners.camera, minlength=len(joined))
    best = [
        int(group[np.argmax(seen[group])]) for each in np.unique(joined) for group in [np.flatnonzero(joined == each)]
    ]
    return sorted({*best, *np.flatnonzero(seen == 0).tolist()})


def lens_priors(sizes: Sequence[tuple[int, int]]) -> tuple[Floats, Floats]:
    """Return what is known of all common unknowns before a calibration.

    Args:
        sizes: Width and height of the images of each camera [px].

    Returns:
        Means and standard deviations (16 C + 4,), the latter infinite for focal lengths and poses.
    """
    mean, sd = np.zeros((len(sizes), CAMERA)), np.full((len(sizes), CAMERA), np.inf)
    for camera, size in enumerate(sizes):
        mean[camera, 2:4] = (np.array(size) - 1) / 2
        sd[camera, 2:4] = _CENTRE_SD * max(size)
        for name, value in _LENS_SD.items():
            sd[camera, LENS_NAMES.index(name)] = value
    delay = np.full(len(sizes), _DELAY_SD)
    return (
        np.concatenate([mean.ravel(), np.zeros(SHAPE), np.zeros(len(sizes))]),
        np.concatenate([sd.ravel(), _SHAPE_SD, delay]),
    )  # fmt: skip


def timed_cameras(corners: CornerSet) -> Mask:
    """Return the cameras (C,) whose delays are estimated: those of whose corners a motion is known."""
    timed = np.zeros(len(corners.cameras), bool)
    if corners.motion is not None:
        timed[corners.camera[np.any(corners.motion != 0, axis=1)]] = True
    return timed
