"""Shapes before one camera that shows a thing larger and smaller as it comes and goes: scaled orthographic projection.

Each frame has a magnification besides its rotation and shift. A shape that grows as a whole and one that comes nearer
look alike, so the object's size as a whole is held, as before several cameras (`held_size`).
"""

from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.nonrigid.core.completion import complete_tracks
from marey.nonrigid.many_cameras.held_size import magnifications
from marey.nonrigid.one_camera.one_view import COMPLETING_RANK, NonRigidShapes, factorise_tracks

LEAST = 0.2
"""Magnifications below this share of the middle one mean that no rigid object fits."""
ROUNDS = 2
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Elements of a symmetric metric."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ScaledShapes:
    """Shapes of one size: tracks = magnification times the first two rows of rotation @ shape, + translation."""

    shapes: NonRigidShapes
    """Those of the tracks divided by the magnification; its translations and residuals are divided, too."""
    magnification: Floats
    """(F,) how large a frame's picture is, 1 on average."""

    def __post_init__(self) -> None:
        freeze_fields(self, "magnification")

    @property
    def in_tracks_unit(self) -> NonRigidShapes:
        """The shapes with translations and residuals as the tracks have them; the shapes stay of one size."""
        plain, size = self.shapes, self.magnification[:, None]
        return replace(plain, translation=plain.translation * size, residuals=plain.residuals * size)


def factorise_scaled(tracks: Floats, *, rank: int | None = None) -> ScaledShapes:
    """Find shapes and magnifications from the tracks of one scaled orthographic camera ([Alexander2003] section 2.4).

    Args:
        tracks: (F, 2, P) as for `factorise_tracks`.
        rank: K, the number of basis shapes with the mean; None chooses it.

    Returns:
        The shapes. Their standard deviations are those of known magnifications.

    Raises:
        MareyError: As `factorise_tracks`.
        SettingProblem: As `factorise_tracks`.
    """
    tracks = np.asarray(tracks, float)
    seen: Mask = np.asarray(np.isfinite(tracks).all(1))
    magnification: Floats = np.ones(len(tracks))
    if seen.any(1).all() and seen.any(0).all():
        complete = tracks if seen.all() else complete_tracks(tracks, seen, COMPLETING_RANK)[0]
        magnification = rigid_magnifications(complete - complete.mean(2, keepdims=True))
    for _ in range(ROUNDS - 1):
        found = factorise_tracks(tracks / magnification[:, None, None], rank=rank)
        magnification = magnification * magnifications(found.shape, seen)
    return ScaledShapes(
        shapes=factorise_tracks(tracks / magnification[:, None, None], rank=rank), magnification=magnification
    )


def rigid_magnifications(tracks: Floats) -> Floats:
    """Find each frame's magnification as if the object were rigid ([Poelman1997]).

    A frame's two rows are orthogonal and of one length in the space of the three strongest columns, once that space's
    metric is found; the length is the magnification. The metric breaks this least beside the lengths that it gives.

    Args:
        tracks: (F, 2, P) complete, centred in each frame.

    Returns:
        (F,) with the geometric mean 1; all 1 where no metric fits.
    """
    frames, _, points = tracks.shape
    u, d, _ = np.linalg.svd(tracks.reshape(2 * frames, points), full_matrices=False)
    rows = (u[:, :3] * d[:3]).reshape(frames, 2, -1)
    if rows.shape[2] < 3 or d[2] <= 0:
        return np.ones(frames)
    x, y = rows[:, 0], rows[:, 1]
    lengths = (_products(x, x) + _products(y, y)) / 2
    conditions = np.concatenate([(_products(x, x) - _products(y, y)) / 2, _products(x, y)])
    squares = lengths @ _least_ratio(conditions, lengths)
    squares = squares * np.sign(np.median(squares))
    if squares.min() <= LEAST**2 * np.median(squares):
        return np.ones(frames)
    return np.asarray(np.sqrt(squares / np.exp(np.log(squares).mean())))


def _products(a: Floats, b: Floats) -> Floats:
    """Write a' Q b as a product with the six elements of Q."""
    return np.stack([a[:, i] * b[:, j] + (a[:, j] * b[:, i] if i != j else 0) for i, j in _PAIRS], 1)


def _least_ratio(conditions: Floats, lengths: Floats) -> Floats:
    """Give the metric under which the conditions are smallest beside the lengths: a generalised eigenvector."""
    broken, whole = conditions.T @ conditions, lengths.T @ lengths
    whole += 1e-12 * np.trace(whole) * np.eye(len(whole))
    half = np.linalg.inv(np.linalg.cholesky(whole))
    return np.asarray(half.T @ np.linalg.eigh(half @ broken @ half.T)[1][:, 0])
