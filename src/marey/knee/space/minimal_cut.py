"""Segmentation of a volume by minimal cut: the voxels' evidence against the area of the surface, solved exactly."""

import numpy as np

from marey.arrays import Integers, Mask
from marey.compiled.kernels import kernel

_ITERATIONS = 150
"""Number of iterations; chosen by hand."""
_SETTLED = 50.0
"""Log odds [nats] beyond which a voxel is fixed; larger than any evidence from an image."""


def minimal_cut(
    evidence: np.ndarray,
    start: Mask,
    spacing_mm: tuple[float, float, float],
    *,
    surface_nats_mm: float | np.ndarray,
    iterations: int = _ITERATIONS,
) -> np.ndarray:
    """Find the part of a volume with the most evidence minus a price for its surface.

    Minimises sum(-evidence u) + price |grad u| over u in [0, 1], the convex form of the minimal surface
    [Chan2006], by the primal-dual steps of [Chambolle2011] algorithm 1 with steps of each axis' own size.

    Args:
        evidence: (k, j, i) float32: log odds [nats] of each voxel to be inside; beyond +-50 it is fixed.
        start: (k, j, i) initial guess.
        spacing_mm: Of the voxels along k, j, i.
        surface_nats_mm: Price of the surface, as one number or (k, j, i) for each voxel; divided by the evidence of a
            voxel it is the radius [mm] below which bumps are smoothed away, for voxels of any size.
        iterations: Number of iterations; more are needed where the initial guess is far off.

    Returns:
        (k, j, i) float32 u: inside above 0.5, between 0 and 1 at the surface.
    """
    steps = np.asarray(spacing_mm, dtype=np.float32)
    inside = start.astype(np.float32)
    odds = np.ascontiguousarray(evidence, dtype=np.float32)
    settled = np.abs(odds) > _SETTLED
    inside[settled] = odds[settled] > 0
    moving, flowing = _moving_and_flowing(~settled)
    price = np.ascontiguousarray(np.broadcast_to(surface_nats_mm, odds.shape), dtype=np.float32)
    _primal_dual(odds, inside, moving, flowing, price, steps, iterations)
    return inside


def _moving_and_flowing(open_: Mask) -> tuple[Integers, Integers]:
    """Return the voxels (n, 3) that are not fixed, and those (m, 3) that are or follow one along an axis."""
    flowing = open_.copy()
    flowing[:-1] |= open_[1:]
    flowing[:, :-1] |= open_[:, 1:]
    flowing[:, :, :-1] |= open_[:, :, 1:]
    return np.argwhere(open_).astype(np.int32), np.argwhere(flowing).astype(np.int32)


@kernel(fastmath=True)
def _primal_dual(evidence, inside, moving, flowing, price, spacing, iterations):  # type: ignore[no-untyped-def]
    """Compute the solution in place in `inside`; only the moving voxels change."""
    deep, high, wide = evidence.shape
    hz, hy, hx = spacing[0], spacing[1], spacing[2]
    tau = np.float32(1.0) / (2 / hz + 2 / hy + 2 / hx)
    pz, py, px = np.zeros_like(evidence), np.zeros_like(evidence), np.zeros_like(evidence)
    ahead = inside.copy()
    for _ in range(iterations):
        for n in range(len(flowing)):
            z, y, x = flowing[n, 0], flowing[n, 1], flowing[n, 2]
            here = ahead[z, y, x]
            a = pz[z, y, x] + np.float32(0.5) * (ahead[z + 1, y, x] - here) if z < deep - 1 else np.float32(0)
            b = py[z, y, x] + np.float32(0.5) * (ahead[z, y + 1, x] - here) if y < high - 1 else np.float32(0)
            c = px[z, y, x] + np.float32(0.5) * (ahead[z, y, x + 1] - here) if x < wide - 1 else np.float32(0)
            size = np.sqrt(a * a + b * b + c * c)
            most = price[z, y, x]
            share = most / size if size > most else np.float32(1)
            pz[z, y, x], py[z, y, x], px[z, y, x] = a * share, b * share, c * share
        for n in range(len(moving)):
            z, y, x = moving[n, 0], moving[n, 1], moving[n, 2]
            flow = pz[z, y, x] / hz + py[z, y, x] / hy + px[z, y, x] / hx
            flow -= pz[z - 1, y, x] / hz if z > 0 else np.float32(0)
            flow -= py[z, y - 1, x] / hy if y > 0 else np.float32(0)
            flow -= px[z, y, x - 1] / hx if x > 0 else np.float32(0)
            before = inside[z, y, x]
            value = min(max(before + tau * (flow + evidence[z, y, x]), np.float32(0)), np.float32(1))
            inside[z, y, x] = value
            ahead[z, y, x] = 2 * value - before
