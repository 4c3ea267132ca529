"""Start of a session with a wand when nothing is known of the lenses: focal lengths tried, ends told apart, staged."""

from dataclasses import replace

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.calibration.adjustment.adjust import adjust
from marey.calibration.adjustment.problem import default_lens, session_problem
from marey.calibration.adjustment.projection import project_corners
from marey.calibration.adjustment.start import SessionStart, guessed_lens
from marey.calibration.adjustment.state import LENS_NAMES
from marey.calibration.adjustment.wand_start import start_focal_lengths, start_wand, with_wand_poses
from marey.calibration.boards.corners import CornerSet
from marey.calibration.boards.wand import CalibrationWand

_TRIED = 4
"""Number of focal lengths from which the adjustment is started; chosen by hand."""
_TRIED_PICTURES = 150
"""Number of pictures with which they are compared; chosen by hand."""
_STAGES = (("fx", "fy"), ("fx", "fy", "k1"), ("fx", "fy", "k1", "k2", "p1", "p2", "cx", "cy"))
"""Parameters of the lenses that are estimated one after the other."""
_GOOD_PX = 30.0
"""Residual up to which a picture takes part in the next stage [px]; chosen by hand."""


def start_wand_session(
    corners: CornerSet, wand: CalibrationWand, lenses: Floats | None
) -> tuple[CornerSet, SessionStart]:
    """Find start values of lenses and poses, and which end of the wand is which.

    Args:
        corners: Points of the wand; if its ends look alike, they may be exchanged.
        wand: The wand.
        lenses: (C, 9) start values of the lenses; None if nothing is known of them.

    Returns:
        The corners with consistent ends, and the start.
    """
    corners = with_upper_end_first(corners, wand) if wand.alike else corners
    if lenses is not None:
        return _started(corners, wand, lenses)
    thinned = _thinned(corners)
    tried = []
    for focal in start_focal_lengths(corners)[:_TRIED]:
        guess = np.stack([guessed_lens(size, focal) for size in corners.sizes])
        used, start = _started(thinned, wand, guess)
        if start.seen.any():
            error = _typical_error(used, wand, start)
            tried.append((-np.count_nonzero(start.joined == np.bincount(start.joined).argmax()), error, start))
    if not tried:
        return _started(corners, wand, np.stack([guessed_lens(size) for size in corners.sizes]))
    best = min(tried, key=lambda each: each[:2])[2]
    return _continued(corners, wand, best)


def _thinned(corners: CornerSet) -> CornerSet:
    """Keep some pictures that several cameras see, evenly distributed."""
    views = np.bincount(corners.view_picture, minlength=len(corners.pictures))
    several = np.flatnonzero(views > 1)
    keep = several[np.unique(np.linspace(0, len(several) - 1, min(len(several), _TRIED_PICTURES)).astype(int))]
    return corners.subset(np.isin(corners.picture, keep)) if len(keep) else corners


def _started(corners: CornerSet, wand: CalibrationWand, lenses: Floats) -> tuple[CornerSet, SessionStart]:
    start = start_wand(corners, wand, lenses)
    if not start.seen.any():
        return corners, start
    for names in _STAGES:
        corners, start = _stage(corners, wand, start, names)
    return corners, start


def _continued(corners: CornerSet, wand: CalibrationWand, start: SessionStart) -> tuple[CornerSet, SessionStart]:
    """Use the cameras of a start with all pictures."""
    return _stage(corners, wand, start, _STAGES[-1])


def _stage(
    corners: CornerSet, wand: CalibrationWand, start: SessionStart, names: tuple[str, ...]
) -> tuple[CornerSet, SessionStart]:
    """Place the wand with the present cameras, and adjust poses and some parameters of the lenses."""
    if wand.alike:
        corners = with_consistent_ends(corners, wand, start)
    state, seen = with_wand_poses(start.state, corners, wand, start.joined)
    used = corners.subset(seen[corners.picture])
    if not len(used):
        return corners, replace(start, seen=seen)
    problem = session_problem(used, wand, default_lens(used), start.joined, shape=False)
    apart = np.linalg.norm(used.pixels - project_corners(state, problem.places)[0], axis=1)
    limit = max(_GOOD_PX, 3 * float(np.nanmedian(apart)))
    good = used.subset(np.nan_to_num(apart, nan=np.inf) < limit)
    if not len(good):
        return corners, replace(start, seen=seen)
    lens = default_lens(good)
    lens[:, [k for k, name in enumerate(LENS_NAMES) if name not in names]] = False
    # Delays are estimated when the cameras are known.
    problem = session_problem(replace(good, motion=None), wand, lens, start.joined, shape=False)
    found = adjust(problem, state, rounds=2, iterations=15, displaced=False)
    return corners, replace(start, state=found.state, seen=seen)


def _typical_error(corners: CornerSet, wand: CalibrationWand, start: SessionStart) -> float:
    """Return the median distance of the points from their predictions [px]; those without a place count as far off."""
    used = corners.subset(start.seen[corners.picture])
    problem = session_problem(used, wand, default_lens(used), start.joined, shape=False)
    apart = np.linalg.norm(used.pixels - project_corners(start.state, problem.places)[0], axis=1)
    lost = len(corners) - len(used)
    return float(np.median(np.concatenate([np.nan_to_num(apart, nan=1e3), np.full(lost, 1e3)])))


def with_upper_end_first(corners: CornerSet, wand: CalibrationWand) -> CornerSet:
    """Order the ends of a wand that look alike by their height in the image.

    Cameras that look about level see the same end above; the others are corrected when the cameras are known.

    Args:
        corners: Points of the wand.
        wand: The wand.

    Returns:
        The corners.
    """
    return _with_ends_exchanged(corners, wand, _last_above(corners, len(wand.points) - 1))


def _last_above(corners: CornerSet, last: int) -> Mask:
    """Return (V,) whether the last point of each view lies above the first."""
    change = np.zeros(len(corners.view_starts))
    np.add.at(change, corners.view, np.where(corners.corner == last, corners.pixels[:, 1], 0.0))
    np.add.at(change, corners.view, np.where(corners.corner == 0, -corners.pixels[:, 1], 0.0))
    both = np.bincount(corners.view, np.isin(corners.corner, (0, last)), minlength=len(change)) == 2
    return np.asarray(both & (change < 0))


def _with_ends_exchanged(corners: CornerSet, wand: CalibrationWand, views: Mask) -> CornerSet:
    last = len(wand.points) - 1
    corner = np.where(views[corners.view], last - corners.corner, corners.corner)
    return replace(corners, corner=corner).ordered(np.lexsort((corner, corners.camera, corners.picture)))


def with_consistent_ends(corners: CornerSet, wand: CalibrationWand, start: SessionStart) -> CornerSet:
    """Exchange the ends of a wand in views where that makes the cameras of the picture agree better.

    Args:
        corners: Points of the wand.
        wand: The wand.
        start: The cameras.

    Returns:
        The corners.
    """
    own = _end_errors(corners, wand, start, np.zeros(len(corners.view_starts), bool))
    exchanged = np.zeros(len(own), bool)
    for turn in range(max(np.bincount(corners.view_picture).max() - 1, 0)):
        # One view of each picture is tried at a time: the one behind the first by the number of the turn.
        trial = exchanged ^ (_place_in_picture(corners) == turn + 1)
        other = _end_errors(corners, wand, start, trial)
        better = other < own
        exchanged, own = np.where(better, trial, exchanged), np.where(better, other, own)
    return _with_ends_exchanged(corners, wand, exchanged)


def _place_in_picture(corners: CornerSet) -> Integers:
    """Return the number of each view (V,) within its picture."""
    picture = corners.view_picture
    first = np.searchsorted(picture, picture)
    return np.asarray(np.arange(len(picture)) - first)


def _end_errors(corners: CornerSet, wand: CalibrationWand, start: SessionStart, exchanged: Mask) -> Floats:
    """Return the mean distance of the points of each view's picture from their predictions (V,) [px], bounded."""
    trial = _with_ends_exchanged(corners, wand, exchanged)
    state, seen = with_wand_poses(start.state, trial, wand, start.joined)
    problem = session_problem(trial, wand, default_lens(trial), start.joined, shape=False)
    apart = np.linalg.norm(trial.pixels - project_corners(state, problem.places)[0], axis=1)
    bound = 0.1 * max(max(size) for size in corners.sizes)
    cost = np.where(seen[trial.picture], np.minimum(np.nan_to_num(apart, nan=bound), bound), bound)
    count = np.bincount(trial.picture, minlength=len(trial.pictures))
    mean = np.bincount(trial.picture, cost, minlength=len(count)) / np.maximum(count, 1)
    return np.asarray(mean[corners.view_picture])
