"""Places that strayed off their point while it was followed, found by what the other cameras and points say."""

import numpy as np

from marey.arrays import Floats, Mask
from marey.nonrigid.core.completion import complete_tracks
from marey.nonrigid.tracking.rank_tracking import choose_rank
from marey.nonrigid.tracking.weighted_factorisation import LowRankTracks, PlaceEquations, factorise

_ROUNDS = 4
_FEWEST = 5
"""Fewer strays in a round are left at that."""
_FAR = 4.0
"""Distance from what is foretold, in standard deviations, beyond which a place is a stray."""
_LEAST_SD = 0.1
"""No place is trusted more than this [px]: patches on a curved surface slide a little."""
_SHORT = 4
"""A point that is seen again for fewer frames than this was most likely not seen [frames]."""
_SPARSE = 0.3
"""A camera that sees a smaller share of its points in a frame sees them edge-on, and badly."""
_COMPLETING_RANK = 12


def without_strays(tracks: Floats, tracks_sd: Floats) -> Floats:
    """Take out places that are no good, when points are followed in several fixed cameras.

    All cameras' tracks are of one low rank together. Each point's place in a camera is foretold by what the other
    cameras saw of it; where that fails by far, the place goes that fails most. Glimpses, and frames in which a
    camera has lost most of its points, go too.

    Args:
        tracks: (C, F, 2, P) [px]; NaN where not seen.
        tracks_sd: (C, F, 2, P) their standard deviations [px].

    Returns:
        The tracks (C, F, 2, P), NaN also where a place was taken out.
    """
    kept = _without_glimpses(np.array(tracks, float))
    rank: int | None = None
    for _ in range(_ROUNDS):
        equations, places = _equations(kept, tracks_sd)
        if rank is None:
            rank, _curve = choose_rank(equations, places)
        far = _distances(kept.shape[:2], equations, places, factorise(equations, places, rank))
        stray = (far > _FAR) & (far >= far.max(axis=0))
        kept = np.where(stray[:, :, None], np.nan, kept)
        if stray.sum() < _FEWEST:
            break
    return _without_glimpses(kept)


def _without_glimpses(tracks: Floats) -> Floats:
    seen: Mask = np.array(np.isfinite(tracks[:, :, 0]))
    known = seen.any(axis=1).sum(axis=1)
    seen[seen.sum(axis=2) < _SPARSE * known[:, None]] = False
    length = np.zeros(seen.shape, int)
    run = np.zeros_like(seen[:, 0], int)
    for frame in range(seen.shape[1]):
        run = np.where(seen[:, frame], run + 1, 0)
        length[:, frame] = run
    for frame in range(seen.shape[1] - 2, -1, -1):
        after = np.where(seen[:, frame + 1], length[:, frame + 1], 0)
        length[:, frame] = np.where(seen[:, frame], np.maximum(length[:, frame], after), 0)
    return np.where((length >= min(_SHORT, seen.shape[1]))[:, :, None], tracks, np.nan)


def _equations(tracks: Floats, tracks_sd: Floats) -> tuple[PlaceEquations, Floats]:
    """Give what is known of each place, and places to begin with, cameras one after the other as if frames."""
    cameras, frames, _, count = tracks.shape
    flat, spread = tracks.reshape(-1, 2, count), tracks_sd.reshape(-1, 2, count)
    seen: Mask = np.asarray(np.isfinite(flat).all(axis=1))
    used = seen.sum(axis=1) >= 3
    known = np.where(seen[used][:, None], flat[used], 0)
    low, _ = complete_tracks(known, seen[used], min(_COMPLETING_RANK, count - 2))
    middle = ((known - low) * seen[used][:, None]).sum(2) / seen[used].sum(1)[:, None]
    places = np.zeros((cameras * frames, count, 2))
    places[used] = np.swapaxes(np.where(seen[used][:, None], flat[used], low + middle[:, :, None]), 1, 2)
    firm = 1 / (np.swapaxes(np.where(seen[:, None], spread, 1.0), 1, 2) ** 2 + _LEAST_SD**2)
    firm *= (seen & used[:, None])[..., None]
    return PlaceEquations(information=firm[..., None] * np.eye(2), right=firm * places), places


def _distances(shape: tuple[int, int], equations: PlaceEquations, places: Floats, model: LowRankTracks) -> Floats:
    """Give how far (C, F, P) places lie from what the other cameras foretell, in standard deviations; 0 if unseen."""
    cameras, frames = shape
    seen = equations.known
    rows, variance = np.nan_to_num(model.rows), model.spread**2 + _LEAST_SD**2
    weights, weight = rows[..., 1:], np.nan_to_num(model.weight) * seen
    left = (places - rows[:, None, :, 0]) * seen[..., None]
    parts = [slice(camera * frames, (camera + 1) * frames) for camera in range(cameras)]
    normal = np.stack([np.einsum("fp,fia,fib->pab", weight[s], weights[s], weights[s], optimize=True) for s in parts])
    side = np.stack([np.einsum("fp,fpi,fia->pa", weight[s], left[s], weights[s], optimize=True) for s in parts])
    normal, side = normal / variance, side / variance
    square = np.zeros(seen.shape)
    for camera, own in enumerate(parts):
        doubt = np.linalg.inv(np.eye(weights.shape[2]) + normal.sum(0) - normal[camera])
        away = left[own] - np.einsum("fia,pab,pb->fpi", weights[own], doubt, side.sum(0) - side[camera], optimize=True)
        spread = np.einsum("fia,pab,fjb->fpij", weights[own], doubt, weights[own], optimize=True) + variance * np.eye(2)
        square[own] = np.einsum("fpi,fpi->fp", away, np.linalg.solve(spread, away[..., None])[..., 0])
    # Where the model fails everywhere, that is no stray's fault: the middle of two squares' sum is 1.386.
    square = np.where(seen, square / max(1.0, float(np.median(square[seen])) / 1.386), 0)
    return np.asarray(np.sqrt(square).reshape(cameras, frames, -1))
