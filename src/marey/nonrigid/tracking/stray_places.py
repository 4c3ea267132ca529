"""Outliers of tracks in several cameras, found by the predictions of the other cameras and points."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask
from marey.nonrigid.core.completion import TRACKING_RANK, complete_tracks
from marey.nonrigid.tracking.rank_tracking import choose_tracking_rank
from marey.nonrigid.tracking.weighted_factorisation import LowRankTracks, PlaceEquations, low_rank_tracks

SPARSE_FRAME = 0.3
"""A frame in which a camera sees a smaller fraction of its points is ignored: the surface is then seen nearly edge-on.
Chosen by hand; results were not measured against other values."""


@dataclass(frozen=True, kw_only=True)
class StraySettings:
    """Settings of the search for outliers; chosen by hand, results were not measured against other values."""

    rounds: int = 4
    """Largest number of rounds."""
    fewest: int = 5
    """Rounds end when fewer outliers are found."""
    far: float = 4.0
    """Distance from the prediction, in standard deviations, beyond which a position is an outlier."""
    least_sd: float = 0.1
    """Least standard deviation of a position [px]: patches on a curved surface slide slightly."""
    shortest: int = 4
    """Shorter appearances of a point are removed [frames]."""
    sparse: float = SPARSE_FRAME
    """Frames in which a camera sees a smaller fraction of its points are removed."""
    completion_rank: int = TRACKING_RANK
    """Rank, beside the translation, with which tracks are completed for initial values."""


def without_strays(tracks: Floats, tracks_sd: Floats, settings: StraySettings = StraySettings()) -> Floats:
    """Remove outliers from the tracks of points in several fixed cameras.

    The tracks of all cameras together have one low rank. The position of each point in a camera is predicted from the
    other cameras; where the prediction fails, the position with the largest error is removed. Short appearances, and
    frames in which a camera has lost most of its points, are removed as well.

    Args:
        tracks: (C, F, 2, P) [px]; NaN where not seen.
        tracks_sd: (C, F, 2, P) standard deviations [px].
        settings: Tuned constants.

    Returns:
        The tracks (C, F, 2, P), with NaN also where positions were removed.
    """
    kept = _without_glimpses(np.array(tracks, float), settings)
    rank: int | None = None
    for _ in range(settings.rounds):
        equations, places = _equations(kept, tracks_sd, settings)
        if rank is None:
            rank, _curve = choose_tracking_rank(equations, places)
        model = low_rank_tracks(equations, places, rank)
        far = _distances(kept.shape[:2], equations, places, model, settings.least_sd)
        stray = (far > settings.far) & (far >= far.max(axis=0))
        kept = np.where(stray[:, :, None], np.nan, kept)
        if stray.sum() < settings.fewest:
            break
    return _without_glimpses(kept, settings)


def _without_glimpses(tracks: Floats, settings: StraySettings) -> Floats:
    """Remove short appearances of points, and frames in which a camera sees few of its points."""
    seen: Mask = np.array(np.isfinite(tracks[:, :, 0]))
    known = seen.any(axis=1).sum(axis=1)
    seen[seen.sum(axis=2) < settings.sparse * known[:, None]] = False
    length = np.zeros(seen.shape, int)
    run = np.zeros_like(seen[:, 0], int)
    for frame in range(seen.shape[1]):
        run = np.where(seen[:, frame], run + 1, 0)
        length[:, frame] = run
    for frame in range(seen.shape[1] - 2, -1, -1):
        after = np.where(seen[:, frame + 1], length[:, frame + 1], 0)
        length[:, frame] = np.where(seen[:, frame], np.maximum(length[:, frame], after), 0)
    return np.where((length >= min(settings.shortest, seen.shape[1]))[:, :, None], tracks, np.nan)


def _equations(tracks: Floats, tracks_sd: Floats, settings: StraySettings) -> tuple[PlaceEquations, Floats]:
    """Compute the information about each position, and initial positions, with the cameras' frames concatenated."""
    cameras, frames, _, count = tracks.shape
    flat, spread = tracks.reshape(-1, 2, count), tracks_sd.reshape(-1, 2, count)
    seen: Mask = np.asarray(np.isfinite(flat).all(axis=1))
    used = seen.sum(axis=1) >= 3
    known = np.where(seen[used][:, None], flat[used], 0)
    low, _ = complete_tracks(known, seen[used], min(settings.completion_rank, count - 2))
    middle = ((known - low) * seen[used][:, None]).sum(2) / seen[used].sum(1)[:, None]
    places = np.zeros((cameras * frames, count, 2))
    places[used] = np.swapaxes(np.where(seen[used][:, None], flat[used], low + middle[:, :, None]), 1, 2)
    firm = 1 / (np.swapaxes(np.where(seen[:, None], spread, 1.0), 1, 2) ** 2 + settings.least_sd**2)
    firm *= (seen & used[:, None])[..., None]
    return PlaceEquations(information=firm[..., None] * np.eye(2), right=firm * places), places


def _distances(
    shape: tuple[int, int], equations: PlaceEquations, places: Floats, model: LowRankTracks, least_sd: float
) -> Floats:
    """Compute distances (C, F, P) from the other cameras' predictions, in standard deviations; 0 if unseen."""
    cameras, frames = shape
    seen = equations.known
    rows, variance = np.nan_to_num(model.rows), model.spread**2 + least_sd**2
    weights, weight = rows[..., 1:], np.nan_to_num(model.weight) * seen
    left = (places - rows[:, None, :, 0]) * seen[..., None]
    parts = [slice(camera * frames, (camera + 1) * frames) for camera in range(cameras)]
    normal = np.stack([np.einsum("fp,fia,fib->pab", weight[s], weights[s], weights[s], optimize=True) for s in parts])
    side = np.stack([np.einsum("fp,fpi,fia->pa", weight[s], left[s], weights[s], optimize=True) for s in parts])
    normal, side = normal / variance, side / variance
    square = np.zeros(seen.shape)
    for camera, own in enumerate(parts):
        uncertainty = np.linalg.inv(np.eye(weights.shape[2]) + normal.sum(0) - normal[camera])
        away = left[own] - np.einsum(
            "fia,pab,pb->fpi", weights[own], uncertainty, side.sum(0) - side[camera], optimize=True
        )
        spread = np.einsum(
            "fia,pab,fjb->fpij", weights[own], uncertainty, weights[own], optimize=True
        ) + variance * np.eye(2)
        square[own] = np.einsum("fpi,fpi->fp", away, np.linalg.solve(spread, away[..., None])[..., 0])
    # Relative to the median error, if the model fails everywhere: that of the chi-square distribution is 1.386.
    square = np.where(seen, square / max(1.0, float(np.median(square[seen])) / 1.386), 0)
    return np.asarray(np.sqrt(square).reshape(cameras, frames, -1))
