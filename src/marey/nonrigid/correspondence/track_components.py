"""Tracks made ready for comparing cameras: gaps filled, translation taken out, few components in time kept."""

import numpy as np

from marey.arrays import Floats, Mask
from marey.nonrigid.core.completion import TRACKING_RANK, complete_tracks

_COMPONENTS = 24
"""Components in time that are kept of the tracks of both cameras."""
_LEAST_SEEN = 3
_SPARSE = 0.3
"""A frame in which a camera sees fewer points, or a smaller share of them, is left out."""
_STILL = 6.5
"""Largest square singular value of white noise over the middle one, at most."""


def seen_in(tracks: Floats) -> Mask:
    """Tell where points are seen, (F, P) of tracks (F, 2, P)."""
    return np.asarray(np.isfinite(tracks).all(axis=1))


def full_frames(tracks: Floats) -> Mask:
    """Tell in which frames (F,) a camera sees many of its points."""
    count = seen_in(tracks).sum(axis=1)
    return np.asarray(count >= max(_LEAST_SEEN, _SPARSE * tracks.shape[2]))


def prepared(tracks: Floats) -> Floats:
    """Take the translation out, fill gaps by the tracks' own low rank, and give unit spread."""
    seen = seen_in(tracks)
    known = np.where(seen[:, None], tracks, 0)
    if seen.all():
        filled = known - known.mean(2, keepdims=True)
    else:
        low, _ = complete_tracks(known, seen, min(TRACKING_RANK, tracks.shape[2] - 2, 2 * len(tracks) - 2))
        middle = ((known - low) * seen[:, None]).sum(2) / seen.sum(1)[:, None]
        filled = np.where(seen[:, None], known - middle[:, :, None], low)
    return np.asarray(filled / max(float(np.sqrt(np.mean(np.sum(filled**2, axis=1)))), 1e-300))


def moves(tracks: Floats) -> bool:
    """Tell whether points move against each other more than noise does."""
    motion = (tracks - tracks.mean(0)).reshape(len(tracks), -1)
    values = np.linalg.svd(motion, compute_uv=False)[: min(len(tracks) - 1, motion.shape[1] - 4)]
    return bool(values[0] ** 2 > max(_STILL * float(np.median(values**2)), 1e-16 * tracks.size))


def components(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Give the few components in time (K, 2, P) and (K, 2, Q) that hold the tracks of both cameras."""
    frames, size = len(a), a[0].size
    together = np.concatenate([a.reshape(frames, -1), b.reshape(frames, -1)], axis=1)
    times = np.linalg.svd(together, full_matrices=False)[0][:, :_COMPONENTS]
    few = times.T @ together / np.sqrt(frames)
    return few[:, :size].reshape(-1, 2, a.shape[2]), few[:, size:].reshape(-1, 2, b.shape[2])
