"""Low-rank completion of a cluster's shape over time: missing markers are predicted from the others."""

import numpy as np

from marey.arrays import Floats
from marey.geometry import rotations
from marey.markers.data.rigid_fit import in_cluster_frame, mean_shape

_ALTERNATIONS = 12
"""Alternations between the modes and their coefficients. Chosen by hand."""
_REALIGNMENTS = 2
"""Rounds of alignment and completion in the prediction of markers. Chosen by hand."""


def complete(values: Floats, rank: int, free: Floats | None = None) -> Floats:
    """Approximate rows with missing entries by their mean and a few modes, estimated from the known entries.

    Alternating least squares over the modes and each row's coefficients. The coefficients are regularised with unit
    variance relative to the residual variance, as in probabilistic principal component analysis.

    Args:
        values: (F, C); NaN where missing. A column that is never known stays NaN.
        rank: Number of modes; 0 for the mean only.
        free: (C, G) further directions with coefficients that are not regularised.

    Returns:
        (F, C) the approximation of every entry.
    """
    known = np.isfinite(values)
    held = np.where(known, values, 0.0)
    mean = np.where(known.any(0), held.sum(0) / np.maximum(known.sum(0), 1), np.nan)
    free = np.zeros((values.shape[1], 0)) if free is None else np.nan_to_num(free)
    start = np.where(known, values - mean, 0.0)
    _, size, modes = np.linalg.svd(np.nan_to_num(start), full_matrices=False)
    modes = (modes[:rank] * size[:rank, None] / np.sqrt(len(values))).T
    noise = float(((start**2).sum() - (size[:rank] ** 2).sum()) / max(known.sum(), 1))
    centre = np.nan_to_num(mean)
    for _ in range(_ALTERNATIONS if rank else 1):
        parts = _mode_coefficients(held - centre, known, np.column_stack([modes, free]), rank, max(noise, 1e-14))
        freed = parts[:, rank:] @ free.T
        if rank:
            modes, centre = _fitted_modes(np.where(known, held - freed, 0.0), known, parts[:, :rank])
        described = parts[:, :rank] @ modes.T + centre + freed
        noise = float(((held - described)[known] ** 2).mean()) if known.any() else 0.0
    return np.where(known.any(0), described, np.nan)


def _mode_coefficients(off: Floats, known: np.ndarray, directions: Floats, rank: int, noise: float) -> Floats:
    """Estimate each row's coefficients (F, K + G): of the modes with unit variance, and of the free directions."""
    width = directions.shape[1]
    if not width:
        return np.zeros((len(off), 0))
    ridge = np.where(np.arange(width) < rank, noise, 1e-9 * noise + 1e-15)
    normal = (known @ (directions[:, :, None] * directions[:, None]).reshape(len(directions), -1)).reshape(
        -1, width, width
    ) + np.diag(ridge)
    return np.asarray(np.linalg.solve(normal, (np.where(known, off, 0.0) @ directions)[..., None])[..., 0])


def _fitted_modes(held: Floats, known: np.ndarray, parts: Floats) -> tuple[Floats, Floats]:
    """Estimate the modes (C, K), scaled for coefficients of unit variance, and the mean (C,), from the coefficients."""
    parts = np.column_stack([parts, np.ones(len(held))])
    width = parts.shape[1]
    normal = (known.T @ (parts[:, :, None] * parts[:, None]).reshape(len(parts), -1)).reshape(-1, width, width)
    normal += 1e-9 * max(len(parts), 1) * np.eye(width)
    modes = np.linalg.solve(normal, (held.T @ parts)[..., None])[..., 0]
    return modes[:, :-1] * np.sqrt((parts[:, :-1] ** 2).mean(0)), modes[:, -1]


def predict_markers(points: Floats, rank: int) -> Floats:
    """Predict the markers of a cluster from its mean shape, a few modes of its change, and its pose.

    The pose of a frame is estimated together with its mode coefficients from the visible markers, because a pose fitted
    to fewer markers alone would be biased, and the predicted marker with it.

    Args:
        points: (F, M, 3) in the laboratory [m]; NaN where missing.
        rank: Number of modes.

    Returns:
        (F, M, 3) in the laboratory [m], for the visible markers as well; NaN in frames without a pose.
    """
    frames, count = points.shape[:2]
    whole, shape = points, None
    for _ in range(_REALIGNMENTS):
        local, rotation, translation = in_cluster_frame(whole, shape)
        local = np.where(np.isfinite(points), local, np.nan)
        shape = mean_shape(local)
        moved = np.concatenate([-rotations.hat(shape), np.broadcast_to(np.eye(3), (count, 3, 3))], -1).reshape(-1, 6)
        described = complete(local.reshape(frames, -1), rank, moved).reshape(frames, count, 3)
        predicted = np.einsum("fij,fmj->fmi", rotation, described) + translation[:, None]
        whole = np.where(np.isfinite(points), points, predicted)
    return np.asarray(predicted)
