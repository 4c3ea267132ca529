"""The paper's method for one camera, as a baseline: singular vectors, twice ([Alexander2003] section 2.4)."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.errors import MareyError
from marey.nonrigid.core.metric_upgrade import orthonormal_triple


@dataclass(frozen=True, eq=False, kw_only=True)
class PlainShapes:
    """Result of the plain method: tracks = the first two rows of rotation @ shape, plus translation."""

    shape: Floats
    """(F, 3, P) in the object's frame."""
    rotation: Floats
    """(F, 3, 3) camera from object."""
    translation: Floats
    """(F, 2) image of the object's origin."""
    basis: Floats
    """(K, 3, P) basis shapes."""
    coefficients: Floats
    """(F, K) weights of the basis shapes."""

    def __post_init__(self) -> None:
        freeze_fields(self, "shape", "rotation", "translation", "basis", "coefficients")

    @property
    def rank(self) -> int:
        """Number of basis shapes K."""
        return len(self.basis)


def factorise_plainly(tracks: Floats, rank: int) -> PlainShapes:
    """Factor complete tracks into poses and weights by singular vectors alone ([Bregler2000]).

    W = Q B of rank 3K; each frame's entries of Q, arranged as K x 6, are split into weights and pose by their first
    singular vectors ([Alexander2003] eq. (19)-(21), with two rows of T instead of three); one 3 x 3 matrix then makes
    all poses as nearly orthonormal as possible.

    Args:
        tracks: (F, 2, P) without missing entries.
        rank: Number of basis shapes K.

    Returns:
        The shapes.

    Raises:
        MareyError: An entry is missing, or K is too large for the numbers of frames and points.
    """
    tracks = np.asarray(tracks, float)
    frames, _, points = tracks.shape
    if not np.isfinite(tracks).all():
        raise MareyError("The plain method needs complete tracks: no entry may be NaN.")
    if not 1 <= rank <= min(points, 2 * frames) // 3:
        raise MareyError(
            f"{points} points over {frames} frames do not suit {rank} basis shapes: at least 1 and at most "
            f"{min(points, 2 * frames) // 3} are possible."
        )
    translation = tracks.mean(2)
    left = (tracks - translation[:, :, None]).reshape(2 * frames, points)
    u, d, vt = np.linalg.svd(left, full_matrices=False)
    root = np.sqrt(d[: 3 * rank])
    blocks = (u[:, : 3 * rank] * root).reshape(frames, 2, rank, 3).transpose(0, 2, 1, 3)
    first, size, pose = np.linalg.svd(blocks.reshape(frames, rank, 6), full_matrices=False)
    # the sign of a frame's weights and pose is chosen so that the pose is near that of the previous frame
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
