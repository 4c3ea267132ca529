"""Shapes before one camera of varying magnification: scaled orthographic projection.

Each frame has a magnification besides its rotation and shift. A shape that grows as a whole and one that approaches
look alike, so the object's overall size is held constant, as before several cameras (`held_size`).
"""

from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.nonrigid.core.completion import COMPLETION_RANK, complete_tracks
from marey.nonrigid.core.metric_upgrade import metric_products
from marey.nonrigid.many_cameras.held_size import magnifications
from marey.nonrigid.one_camera.one_view import NonRigidShapes, OneViewSettings, factorise_tracks

_LEAST_MAGNIFICATION = 0.2
"""No rigid object fits the tracks where a magnification is below this fraction of the median. Chosen by hand; results
were not measured against other values."""
_ROUNDS = 2
"""Number of factorisations. Chosen by hand; results were not measured against other values."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ScaledShapes:
    """Shapes of constant size: tracks = magnification times the first two rows of rotation @ shape, + translation."""

    shapes: NonRigidShapes
    """Shapes from the tracks divided by the magnification; translations and residuals are divided as well."""
    magnification: Floats
    """(F,) magnification of a frame, 1 on average."""

    def __post_init__(self) -> None:
        freeze_fields(self, "magnification")

    @property
    def in_tracks_unit(self) -> NonRigidShapes:
        """Shapes with translations and residuals in the unit of the tracks; the shapes keep their constant size."""
        plain, size = self.shapes, self.magnification[:, None]
        return replace(plain, translation=plain.translation * size, residuals=plain.residuals * size)


def factorise_scaled(
    tracks: Floats, *, rank: int | None = None, settings: OneViewSettings | None = None
) -> ScaledShapes:
    """Estimate shapes and magnifications from the tracks of a scaled orthographic camera ([Alexander2003] section 2.4).

    Args:
        tracks: (F, 2, P) as for `factorise_tracks`.
        rank: Number of basis shapes K, including the mean; chosen by evidence if None.
        settings: Tuned constants of `factorise_tracks`; the defaults if None.

    Returns:
        The shapes. Their standard deviations take the magnifications as exact.

    Raises:
        MareyError: As `factorise_tracks`.
        SettingProblem: As `factorise_tracks`.
    """
    tracks, settings = np.asarray(tracks, float), settings or OneViewSettings()
    seen: Mask = np.asarray(np.isfinite(tracks).all(1))
    magnification: Floats = np.ones(len(tracks))
    if seen.any(1).all() and seen.any(0).all():
        complete = tracks if seen.all() else complete_tracks(tracks, seen, COMPLETION_RANK)[0]
        magnification = rigid_magnifications(complete - complete.mean(2, keepdims=True))
    for _ in range(_ROUNDS - 1):
        found = factorise_tracks(tracks / magnification[:, None, None], rank=rank, settings=settings)
        magnification = magnification * magnifications(found.shape, seen)
    shapes = factorise_tracks(tracks / magnification[:, None, None], rank=rank, settings=settings)
    return ScaledShapes(shapes=shapes, magnification=magnification)


def rigid_magnifications(tracks: Floats) -> Floats:
    """Estimate the magnification of each frame as if the object were rigid ([Poelman1997]).

    Under the right metric of the space of the three strongest columns, the two rows of a frame are orthogonal and of
    equal length, the magnification. The metric is that which violates this least relative to the lengths.

    Args:
        tracks: (F, 2, P) complete and centred in each frame.

    Returns:
        (F,) magnifications with geometric mean 1; all 1 where no metric fits.
    """
    frames, _, points = tracks.shape
    u, d, _ = np.linalg.svd(tracks.reshape(2 * frames, points), full_matrices=False)
    rows = (u[:, :3] * d[:3]).reshape(frames, 2, -1)
    if rows.shape[2] < 3 or d[2] <= 0:
        return np.ones(frames)
    x, y = rows[:, 0], rows[:, 1]
    lengths = (metric_products(x, x) + metric_products(y, y)) / 2
    conditions = np.concatenate([(metric_products(x, x) - metric_products(y, y)) / 2, metric_products(x, y)])
    squares = lengths @ _least_ratio(conditions, lengths)
    squares = squares * np.sign(np.median(squares))
    if squares.min() <= _LEAST_MAGNIFICATION**2 * np.median(squares):
        return np.ones(frames)
    return np.asarray(np.sqrt(squares / np.exp(np.log(squares).mean())))


def _least_ratio(conditions: Floats, lengths: Floats) -> Floats:
    """Compute the metric with the smallest conditions relative to the lengths, a generalised eigenvector."""
    broken, whole = conditions.T @ conditions, lengths.T @ lengths
    whole += 1e-12 * np.trace(whole) * np.eye(len(whole))
    half = np.linalg.inv(np.linalg.cholesky(whole))
    return np.asarray(half.T @ np.linalg.eigh(half @ broken @ half.T)[1][:, 0])
