"""Completing a cluster's shape over time: what a missing marker does follows from what the others do."""

import numpy as np

from marey.arrays import Floats
from marey.markers.rigid_fit import fit_rigid

_SD = 1e-3  # m; all markers count alike, so it only says what is too near to a line to tell a turn
_ALIGNMENTS = 4
_ALTERNATIONS = 12
_REALIGNMENTS = 2


def in_cluster(points: Floats) -> tuple[Floats, Floats, Floats]:
    """Take the rigid motion away from a cluster's markers.

    Each frame is fitted to the markers' mean shape, which is the mean of the frames so fitted.

    Args:
        points: (F, M, 3) in the laboratory [m]; NaN where missing.

    Returns:
        The markers in the cluster's frame (F, M, 3), and laboratory from cluster: rotation (F, 3, 3) and translation
        (F, 3). NaN in frames with fewer than three markers, or markers in a line.
    """
    shape = points[np.argmax(np.isfinite(points).all(-1).sum(1))]
    for _ in range(_ALIGNMENTS):
        fit = fit_rigid(shape, points, _SD)
        local = np.einsum("fji,fmj->fmi", fit.rotation, points - fit.translation[:, None])
        shape = _mean(local)
    return local, fit.rotation, fit.translation


def _mean(local: Floats) -> Floats:
    """Average over the frames that are known; NaN for what never is."""
    known = np.isfinite(local)
    count = known.sum(0)
    return np.where(count > 0, np.where(known, local, 0).sum(0) / np.maximum(count, 1), np.nan)


def complete(values: Floats, rank: int) -> Floats:
    """Describe rows with gaps by their mean and a few modes, found from what is known.

    Alternating least squares over the modes and each row's part of them; a part is held to the spread that the parts
    have, in the measure of what the modes leave, as in probabilistic principal components.

    Args:
        values: (F, C); NaN where missing. A column that is never known stays NaN.
        rank: How many modes; 0 leaves the mean.

    Returns:
        (F, C) the description, of every entry.
    """
    known = np.isfinite(values)
    held = np.where(known, values, 0.0)
    mean = np.where(known.any(0), held.sum(0) / np.maximum(known.sum(0), 1), np.nan)
    if rank == 0 or not known.any():
        return np.broadcast_to(mean, values.shape).copy()
    start = np.where(known, values - mean, 0.0)
    _, size, modes = np.linalg.svd(np.nan_to_num(start), full_matrices=False)
    modes = np.column_stack([(modes[:rank] * size[:rank, None] / np.sqrt(len(values))).T, np.nan_to_num(mean)])
    noise = float(((start**2).sum() - (size[:rank] ** 2).sum()) / max(known.sum(), 1))
    for _ in range(_ALTERNATIONS):
        parts = _parts(held, known, modes, max(noise, 1e-14))
        modes = _modes(held, known, parts)
        noise = float(((held - parts @ modes.T)[known] ** 2).mean())
    return np.where(known.any(0), parts @ modes.T, np.nan)


def _parts(held: Floats, known: np.ndarray, modes: Floats, noise: float) -> Floats:
    """Find each row's part of the modes (F, K + 1); the last one, the mean's, is 1."""
    v, mean = modes[:, :-1], modes[:, -1]
    rank = v.shape[1]
    normal = (known @ (v[:, :, None] * v[:, None]).reshape(len(v), -1)).reshape(-1, rank, rank) + noise * np.eye(rank)
    right = (np.where(known, held - mean, 0.0)) @ v
    return np.column_stack([np.linalg.solve(normal, right[..., None])[..., 0], np.ones(len(held))])


def _modes(held: Floats, known: np.ndarray, parts: Floats) -> Floats:
    """Find the modes and the mean (C, K + 1) from the rows' parts, scaled so that the parts have variance one."""
    width = parts.shape[1]
    normal = (known.T @ (parts[:, :, None] * parts[:, None]).reshape(len(parts), -1)).reshape(-1, width, width)
    normal += 1e-9 * max(len(parts), 1) * np.eye(width)
    modes = np.linalg.solve(normal, (held.T @ parts)[..., None])[..., 0]
    modes[:, :-1] *= np.sqrt((parts[:, :-1] ** 2).mean(0))
    return modes


def predict(points: Floats, rank: int) -> Floats:
    """Say where the markers of a cluster should be, by its mean shape, a few modes of its change, and its pose.

    A frame is fitted by the markers that it has; then it is fitted again with the missing ones at their predicted
    places, so that a frame with a gap has the same pose that it would have without.

    Args:
        points: (F, M, 3) in the laboratory [m]; NaN where missing.
        rank: Modes.

    Returns:
        (F, M, 3) in the laboratory [m], for the markers that are there, too; NaN in frames without a pose.
    """
    frames, count = points.shape[:2]
    whole = points
    for _ in range(_REALIGNMENTS):
        local, rotation, translation = in_cluster(whole)
        local = np.where(np.isfinite(points), local, np.nan)
        described = complete(local.reshape(frames, -1), rank).reshape(frames, count, 3)
        predicted = np.einsum("fij,fmj->fmi", rotation, described) + translation[:, None]
        whole = np.where(np.isfinite(points), points, predicted)
    return np.asarray(predicted)
