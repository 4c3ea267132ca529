"""Rotations from tracks alone: one triple of columns that makes the two rows of each frame orthonormal."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.nonrigid.core.completion import singular_vectors

METRIC_ELEMENTS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Indices of the six elements of a symmetric 3 x 3 metric."""

_PERPENDICULAR = np.sqrt(2.0)
"""Weight of the condition that both rows of a frame are perpendicular, beside those of their lengths. The sum of
squares is then that of the elements of the 2 x 2 matrix of their products less the identity, and is the same for all
axes of the image."""


@dataclass(frozen=True, kw_only=True)
class MetricUpgradeSettings:
    """Settings of the search for rotations."""

    ranks: tuple[int, ...] = (2, 3, 4, 6, 8, 12)
    """Numbers of basis shapes for which rotations are computed. Chosen by hand; results were not measured against
    other values."""
    random_starts: int = 8
    """Number of random starts for each number of basis shapes. Half of them or more find the least sum of squares where
    the rigid start and the previous solution fail (`stretch` before a shaken camera, docs/explanation/nonrigid.md)."""
    steps: int = 200
    """Largest number of Levenberg-Marquardt steps; a limit on time."""
    tolerance: float = 1e-10
    """Steps end when the sum of squares falls by less than this fraction; a numerical tolerance."""
    least_singular_value: float = 1e-9
    """Singular values below this fraction of the largest are ignored; a numerical threshold."""


def rotation_candidates(
    tracks: Floats, settings: MetricUpgradeSettings = MetricUpgradeSettings()
) -> Iterator[tuple[int, Floats]]:
    """Compute rotations for several numbers of basis shapes.

    W = Q B has rank 3K ([Alexander2003] eq. (12)); three combinations of the columns of Q are the rotations, times the
    weight of one shape. Unlike the paper, one 3K x 3 matrix G is computed that makes the rows Q_f G of each frame
    orthonormal and of length 1 ([Xiao2004], [Akhter2008]); with free lengths it would shrink to zero. The search for
    each K starts from the previous solution, from the rigid one, and from random matrices.

    Args:
        tracks: (F, 2, P) complete orthographic tracks, centred in each frame.
        settings: Numbers of basis shapes, starts and tolerances.

    Yields:
        Number of basis shapes K and the rotations (F, 3, 3), camera from object.
    """
    frames, _, points = tracks.shape
    u, d, _ = singular_vectors(tracks.reshape(2 * frames, points))
    most = int((d > settings.least_singular_value * d[0]).sum())
    before: Floats | None = None
    rng = np.random.default_rng(0)
    for rank in settings.ranks:
        if 3 * rank > min(points, 2 * frames) or (before is not None and len(before) >= most):
            return
        count = min(3 * rank, most)
        half = u[:, :count] * np.sqrt(d[:count])
        rows = half[0::2], half[1::2]
        rigid = orthonormal_triple(rows[0][:, :3], rows[1][:, :3])
        starts = [np.concatenate([rigid, np.zeros((count - 3, 3))])]
        if before is not None:
            starts.append(np.concatenate([before, np.zeros((count - len(before), 3))]))
        for _ in range(settings.random_starts):
            start = rng.normal(size=(count, 3))
            starts.append(start / np.sqrt(((rows[0] @ start) ** 2).sum(1).mean() / 3))
        before = min((_orthonormal(*rows, start, settings) for start in starts), key=lambda found: found[1])[0]
        yield rank, _continuous(rows[0] @ before, rows[1] @ before)


def metric_products(a: Floats, b: Floats) -> Floats:
    """Compute the coefficients (F, 6) of the elements of a symmetric metric Q in a' Q b, for rows a and b (F, 3)."""
    return np.stack([a[:, i] * b[:, j] + (a[:, j] * b[:, i] if i != j else 0) for i, j in METRIC_ELEMENTS], 1)


def orthonormal_triple(x: Floats, y: Floats) -> Floats:
    """Compute G (3, 3) that makes the rows x G and y G (F, 3) orthonormal, by least squares ([Tomasi1992]).

    All conditions have the weight 1, as in the source, so that the result depends on the axes of the image.
    """
    conditions = np.concatenate([metric_products(x, x), metric_products(y, y), metric_products(x, y)])
    wanted = np.concatenate([np.ones(2 * len(x)), np.zeros(len(x))])
    square = np.zeros((3, 3))
    for (i, j), value in zip(METRIC_ELEMENTS, np.linalg.lstsq(conditions, wanted, rcond=None)[0], strict=True):
        square[i, j] = square[j, i] = value
    size, axes = np.linalg.eigh(square)
    return np.asarray(axes * np.sqrt(np.maximum(size, 1e-3 * np.abs(size).max())))


def _residual(x: Floats, y: Floats, triple: Floats) -> tuple[Floats, Floats, Floats]:
    a, b = x @ triple, y @ triple
    return a, b, np.concatenate([(a * a).sum(1) - 1, (b * b).sum(1) - 1, _PERPENDICULAR * (a * b).sum(1)])


def _orthonormal(x: Floats, y: Floats, triple: Floats, settings: MetricUpgradeSettings) -> tuple[Floats, float]:
    """Solve for G by Levenberg-Marquardt; return it and the sum of squares."""
    a, b, residual = _residual(x, y, triple)
    cost, damping = float(residual @ residual), 1e-3
    for _ in range(settings.steps):
        # Half the derivatives, like those of the lengths beside them.
        across = _PERPENDICULAR / 2 * (np.einsum("fi,fj->fij", x, b) + np.einsum("fi,fj->fij", y, a))
        jacobian = 2 * np.concatenate([np.einsum("fi,fj->fij", x, a), np.einsum("fi,fj->fij", y, b), across])
        jacobian = jacobian.reshape(len(residual), -1)
        normal, gradient = jacobian.T @ jacobian, jacobian.T @ residual
        diagonal = np.diag(normal) + 1e-12 * np.trace(normal)
        for _ in range(12):
            step = np.linalg.solve(normal + damping * np.diag(diagonal), gradient)
            tried = triple - step.reshape(triple.shape)
            a_tried, b_tried, residual_tried = _residual(x, y, tried)
            if float(residual_tried @ residual_tried) < cost:
                break
            damping *= 4
        else:
            return triple, cost
        fall = cost - float(residual_tried @ residual_tried)
        triple, a, b, residual, cost = tried, a_tried, b_tried, residual_tried, cost - fall
        damping = max(damping / 5, 1e-12)
        if fall < settings.tolerance * cost:
            break
    return triple, cost


def _continuous(a: Floats, b: Floats) -> Floats:
    """Convert pairs of rows to rotations; of each and its half turn choose the one nearer to the previous frame."""
    u, _, vt = np.linalg.svd(np.stack([a, b], 1), full_matrices=False)
    rows = u @ vt
    rotation = np.concatenate([rows, np.cross(rows[:, 0], rows[:, 1])[:, None]], 1)
    for f in range(1, len(rotation)):
        turned = rotation[f] * np.array([[-1.0], [-1.0], [1.0]])
        if (turned * rotation[f - 1]).sum() > (rotation[f] * rotation[f - 1]).sum():
            rotation[f] = turned
    return rotation
