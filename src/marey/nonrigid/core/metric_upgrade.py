"""Rotations from the tracks alone: one triple of columns that makes every frame's two rows orthonormal."""

from collections.abc import Iterator

import numpy as np

from marey.arrays import Floats
from marey.nonrigid.core.completion import singular_vectors

RANKS = (2, 3, 4, 6, 8, 12)
"""Numbers of basis shapes that are tried."""
STEPS = 200
CHANCES = 8
"""Starts by chance of every K: half of them or more find the least sum where the others fail."""
STILL = 1e-10
SLIGHTEST = 1e-9
"""A singular value below this share of the largest tells nothing."""


def rotation_candidates(tracks: Floats, ranks: tuple[int, ...] = RANKS) -> Iterator[tuple[int, Floats]]:
    """Find the rotations for several numbers of basis shapes.

    W = Q B has rank 3K ([Alexander2003] eq. (12)); some three columns of Q are the rotations themselves, times one
    shape's weight. Unlike the paper, one 3K x 3 matrix G is sought that makes the rows Q_f G of every frame
    orthonormal and of length 1 ([Xiao2004], [Akhter2008]): with the length left free it would shrink to nothing. Each
    K begins with the last one's answer, with the rigid one, and by chance.

    Args:
        tracks: (F, 2, P) complete, centred in each frame, orthographic.
        ranks: numbers of basis shapes that are tried.

    Yields:
        K and the rotations (F, 3, 3), camera from object.
    """
    frames, _, points = tracks.shape
    u, d, _ = singular_vectors(tracks.reshape(2 * frames, points))
    most = int((d > SLIGHTEST * d[0]).sum())
    before: Floats | None = None
    rng = np.random.default_rng(0)
    for rank in ranks:
        if 3 * rank > min(points, 2 * frames) or (before is not None and len(before) >= most):
            return
        count = min(3 * rank, most)
        half = u[:, :count] * np.sqrt(d[:count])
        rows = half[0::2], half[1::2]
        rigid = orthonormal_triple(rows[0][:, :3], rows[1][:, :3])
        starts = [np.concatenate([rigid, np.zeros((count - 3, 3))])]
        if before is not None:
            starts.append(np.concatenate([before, np.zeros((count - len(before), 3))]))
        for _ in range(CHANCES):
            start = rng.normal(size=(count, 3))
            starts.append(start / np.sqrt(((rows[0] @ start) ** 2).sum(1).mean() / 3))
        before = min((_orthonormal(*rows, start) for start in starts), key=lambda found: found[1])[0]
        yield rank, _continuous(rows[0] @ before, rows[1] @ before)


def orthonormal_triple(x: Floats, y: Floats) -> Floats:
    """Find G (3, 3) that makes the rows x G and y G (F, 3) orthonormal in the sense of least squares ([Tomasi1992])."""
    pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]

    def row(a: Floats, b: Floats) -> Floats:
        return np.stack([a[:, i] * b[:, j] + (a[:, j] * b[:, i] if i != j else 0) for i, j in pairs], 1)

    conditions = np.concatenate([row(x, x), row(y, y), row(x, y)])
    wanted = np.concatenate([np.ones(2 * len(x)), np.zeros(len(x))])
    square = np.zeros((3, 3))
    for (i, j), value in zip(pairs, np.linalg.lstsq(conditions, wanted, rcond=None)[0], strict=True):
        square[i, j] = square[j, i] = value
    size, axes = np.linalg.eigh(square)
    return np.asarray(axes * np.sqrt(np.maximum(size, 1e-3 * np.abs(size).max())))


def _residual(x: Floats, y: Floats, triple: Floats) -> tuple[Floats, Floats, Floats]:
    a, b = x @ triple, y @ triple
    return a, b, np.concatenate([(a * a).sum(1) - 1, (b * b).sum(1) - 1, 2 * (a * b).sum(1)])


def _orthonormal(x: Floats, y: Floats, triple: Floats) -> tuple[Floats, float]:
    """Solve for G by Levenberg-Marquardt; give it and the sum of squares."""
    a, b, residual = _residual(x, y, triple)
    cost, damping = float(residual @ residual), 1e-3
    for _ in range(STEPS):
        across = np.einsum("fi,fj->fij", x, b) + np.einsum("fi,fj->fij", y, a)
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
        if fall < STILL * cost:
            break
    return triple, cost


def _continuous(a: Floats, b: Floats) -> Floats:
    """Make rotations of pairs of rows; of each and its half turn about the sight take the one nearer to the last."""
    u, _, vt = np.linalg.svd(np.stack([a, b], 1), full_matrices=False)
    rows = u @ vt
    rotation = np.concatenate([rows, np.cross(rows[:, 0], rows[:, 1])[:, None]], 1)
    for f in range(1, len(rotation)):
        turned = rotation[f] * np.array([[-1.0], [-1.0], [1.0]])
        if (turned * rotation[f - 1]).sum() > (rotation[f] * rotation[f - 1]).sum():
            rotation[f] = turned
    return rotation
