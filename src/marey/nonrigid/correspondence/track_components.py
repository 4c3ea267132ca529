"""Preparation of tracks for the comparison of cameras: completion, centring, and few components in time."""

import numpy as np

from marey.arrays import Floats, Mask
from marey.nonrigid.core.completion import TRACKING_RANK, complete_tracks
from marey.nonrigid.tracking.stray_places import SPARSE_FRAME

_COMPONENTS = 24
"""Number of components in time by which the tracks of both cameras are represented. Chosen by hand; results were not
measured against other values."""
_LEAST_SEEN = 3
"""Frames in which a camera sees fewer points are ignored; two points do not determine an affine map."""
_STILL = 6.5
"""Points move if their largest squared singular value is more than this times the median; white noise stays below.
Chosen by hand; results were not measured against other values."""


def seen_in(tracks: Floats) -> Mask:
    """Compute the mask (F, P) of the points seen, from tracks (F, 2, P)."""
    return np.asarray(np.isfinite(tracks).all(axis=1))


def full_frames(tracks: Floats) -> Mask:
    """Find the frames (F,) in which a camera sees enough of its points."""
    count = seen_in(tracks).sum(axis=1)
    return np.asarray(count >= max(_LEAST_SEEN, SPARSE_FRAME * tracks.shape[2]))


def prepared(tracks: Floats) -> Floats:
    """Remove the translation from tracks (F, 2, P), fill gaps by their low rank, and scale to unit spread."""
    seen = seen_in(tracks)
    known = np.where(seen[:, None], tracks, 0)
    if seen.all():
        filled = known - known.mean(2, keepdims=True)
    else:
        low, _ = complete_tracks(known, seen, min(TRACKING_RANK, tracks.shape[2] - 2, 2 * len(tracks) - 2))
        middle = ((known - low) * seen[:, None]).sum(2) / seen.sum(1)[:, None]
        filled = np.where(seen[:, None], known - middle[:, :, None], low)
    return np.asarray(filled / max(float(np.sqrt(np.mean(np.sum(filled**2, axis=1)))), 1e-300))


def points_move(tracks: Floats) -> bool:
    """Check whether points move relative to each other by more than noise."""
    motion = (tracks - tracks.mean(0)).reshape(len(tracks), -1)
    values = np.linalg.svd(motion, compute_uv=False)[: min(len(tracks) - 1, motion.shape[1] - 4)]
    return bool(values[0] ** 2 > max(_STILL * float(np.median(values**2)), 1e-16 * tracks.size))


def components(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Compute the components in time, (K, 2, P) and (K, 2, Q), that represent the tracks of both cameras."""
    frames, size = len(a), a[0].size
    together = np.concatenate([a.reshape(frames, -1), b.reshape(frames, -1)], axis=1)
    times = np.linalg.svd(together, full_matrices=False)[0][:, :_COMPONENTS]
    few = times.T @ together / np.sqrt(frames)
    return few[:, :size].reshape(-1, 2, a.shape[2]), few[:, size:].reshape(-1, 2, b.shape[2])
