"""The paper's own method for one camera, as a baseline: singular vectors, twice ([Alexander2003] section 2.4)."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.errors import MareyError
from marey.nonrigid.core.metric_upgrade import orthonormal_triple


@dataclass(frozen=True, eq=False, kw_only=True)
class PlainShapes:
    """What the plain method gives: tracks = the first two rows of rotation @ shape, + translation."""

    shape: Floats
    """(F, 3, P)."""
    rotation: Floats
    """(F, 3, 3) camera from object."""
    translation: Floats
    """(F, 2)."""
    basis: Floats
    """(K, 3, P)."""
    coefficients: Floats
    """(F, K)."""

    def __post_init__(self) -> None:
        freeze_fields(self, "shape", "rotation", "translation", "basis", "coefficients")

    @property
    def rank(self) -> int:
        """K."""
        return len(self.basis)


def factorise_plainly(tracks: Floats, rank: int) -> PlainShapes:
    """Factor complete tracks into poses and weights by singular vectors alone ([Bregler2000]).

    W = Q B of rank 3K; the six columns of each frame's Q, put in order as K x 6, are split into weights and pose by
    their first singular vectors ([Alexander2003] eq. (19)-(21) with two rows of T for three); one 3 x 3 matrix then
    makes all poses as orthonormal as it can.

    Args:
        tracks: (F, 2, P), no entry missing.
        rank: K.

    Raises:
        MareyError: An entry is missing, or K does not suit the numbers of frames and points.
    """
    tracks = np.asarray(tracks, float)
    frames, _, points = tracks.shape
    if not np.isfinite(tracks).all():
        raise MareyError("The plain method needs complete tracks.")
    if not 1 <= rank <= min(points, 2 * frames) // 3:
        raise MareyError(f"{rank} basis shapes do not suit {points} points over {frames} frames.")
    translation = tracks.mean(2)
    left = (tracks - translation[:, :, None]).reshape(2 * frames, points)
    u, d, vt = np.linalg.svd(left, full_matrices=False)
    root = np.sqrt(d[: 3 * rank])
    blocks = (u[:, : 3 * rank] * root).reshape(frames, 2, rank, 3).transpose(0, 2, 1, 3)
    first, size, pose = np.linalg.svd(blocks.reshape(frames, rank, 6), full_matrices=False)
    # the sign of a frame's weights and pose: the pose of a frame lies near the last one's
    weights, poses = first[:, :, 0] * size[:, :1], pose[:, 0].reshape(frames, 2, 3)
    for f in range(1, frames):
        if (poses[f] * poses[f - 1]).sum() < 0:
            poses[f], weights[f] = -poses[f], -weights[f]
    whole = poses * size[:, :1, None]
    correction = orthonormal_triple(whole[:, 0], whole[:, 1])
    half, stretch, other = np.linalg.svd(poses @ correction, full_matrices=False)
    rows, weights = half @ other, weights * stretch.mean(1, keepdims=True)
    basis = np.linalg.solve(correction, (root[:, None] * vt[: 3 * rank]).reshape(rank, 3, points))
    return PlainShapes(
        shape=np.einsum("fk,kip->fip", weights, basis), translation=translation, basis=basis, coefficients=weights,
        rotation=np.concatenate([rows, np.cross(rows[:, 0], rows[:, 1])[:, None]], 1),
    )  # fmt: skip
