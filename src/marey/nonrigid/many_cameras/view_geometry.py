"""Relative geometry of two fixed orthographic cameras from tracks of a deforming object, and placement of further ones.

Two orthographic cameras share one direction, perpendicular to both lines of sight: the images along it agree up to a
scale, however the object deforms. This determines the roll of each camera about its line of sight and the scale, but
not the angle between the lines of sight, which no number of frames determines as long as each frame may have a shape of
its own ([Koenderink1991]).
"""

from dataclasses import dataclass, field

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.geometry import rotations
from marey.nonrigid.core.refinement import FEWEST_FRAMES
from marey.nonrigid.core.track_checks import FEWEST_POINTS


@dataclass(frozen=True, kw_only=True)
class ViewPairSettings:
    """Settings of the relative geometry of two cameras; chosen by hand, results were not measured against others."""

    outlier_ratio: float = 6.0
    """A point has no true partner where its departure from the shared direction is more than this times the
    median..."""
    least_departure: float = 0.01
    """...and more than this fraction of the object's size."""
    rounds: int = 5
    """Largest number of rounds of fitting and removing outliers."""
    sample_points: int = 6
    """Number of points of a random sample."""
    samples: int = 40
    """Number of random samples."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewPair:
    """Relative geometry of two cameras, except for the angle between their lines of sight and the mirror image."""

    first_axes: Floats
    """(3, 3) rows: across the shared direction in the first image, along it, and the line of sight, in camera axes."""
    second_axes: Floats
    """(3, 3) the same for the second camera."""
    scale: float
    """Scale of the second camera over that of the first."""
    spread: Floats
    """(4,) root mean squares of the four stacked coordinates along their principal axes, in ascending order: the first
    is noise, the second the difference (parallax) between the cameras."""
    point_rms: Floats
    """(P,) root mean square departure of a point along the shared direction; NaN where not seen by both cameras."""
    settings: ViewPairSettings = field(default_factory=ViewPairSettings)
    """Criteria for outliers."""

    def __post_init__(self) -> None:
        freeze_fields(self, "first_axes", "second_axes", "spread", "point_rms")

    def second_from_first(self, angle: float) -> Floats:
        """Compute the rotation (3, 3) for an angle [rad] between the lines of sight; minus the angle mirrors depth."""
        return np.asarray(self.second_axes.T @ rotations.exp(np.array([0.0, angle, 0.0])) @ self.first_axes)

    @property
    def outlying(self) -> Mask:
        """(P,) mask of points whose two tracks cannot belong to one point."""
        if not np.isfinite(self.point_rms).any():
            return np.zeros(len(self.point_rms), bool)
        usual, size = float(np.nanmedian(self.point_rms)), float(self.spread[3])
        least = max(self.settings.outlier_ratio * usual, self.settings.least_departure * size)
        return np.asarray(self.point_rms > least)


def view_pair(first: Floats, second: Floats, settings: ViewPairSettings = ViewPairSettings()) -> ViewPair | None:
    """Estimate the relative geometry of two cameras, excluding points without a true partner.

    Args:
        first: (F, 2, P) tracks in the first camera; NaN where not seen.
        second: (F, 2, P) tracks of the same points in the second camera.
        settings: Tuned constants.

    Returns:
        The pair; None where too few points are seen by both cameras or in too few frames.
    """
    stacked = np.concatenate([first, second], 1)
    both = np.isfinite(stacked).all(1)
    often = both.sum(0) >= FEWEST_FRAMES
    used = _consensus(stacked, both, often, settings)
    for _ in range(settings.rounds):
        pair = _pair(stacked, both & used, settings)
        if pair is None:
            return None
        kept = often & ~pair.outlying
        if (kept == used).all():
            break
        used = kept
    return pair


def _consensus(stacked: Floats, both: Mask, often: Mask, settings: ViewPairSettings) -> Mask:
    """Select the points that agree with the best of some random samples; a wrong partner would bias a fit to all."""
    numbers = np.flatnonzero(often)
    if len(numbers) <= settings.sample_points:
        return often
    rng = np.random.default_rng(0)
    best, used = np.inf, often
    for _ in range(settings.samples):
        chosen = np.zeros(len(often), bool)
        chosen[rng.choice(numbers, settings.sample_points, replace=False)] = True
        pair = _pair(stacked, both & chosen, settings)
        if pair is None:
            continue
        middle = float(np.nanmedian(pair.point_rms))
        if middle < best:
            best, used = middle, often & ~pair.outlying
    return used


def along_one_direction(first: Floats, second: Floats) -> ViewPair | None:
    """Estimate the relative geometry of two cameras as `view_pair` does, but from all points."""
    stacked = np.concatenate([first, second], 1)
    return _pair(stacked, np.asarray(np.isfinite(stacked).all(1)), ViewPairSettings())


def _pair(stacked: Floats, used: Mask, settings: ViewPairSettings) -> ViewPair | None:
    enough = used.sum(1) >= FEWEST_POINTS
    if enough.sum() < FEWEST_FRAMES:
        return None
    weight = np.where(enough[:, None], used, False).astype(float)
    middle = (np.nan_to_num(stacked) * weight[:, None]).sum(2) / np.maximum(weight.sum(1), 1)[:, None]
    middle[~enough] = np.nan
    centred = stacked - middle[:, :, None]
    left = np.nan_to_num(centred) * weight[:, None]
    # centring takes one degree of freedom per frame
    count = weight.sum() - enough.sum()
    square, axes = np.linalg.eigh(np.einsum("fip,fjp->ij", left, left) / count)
    normal = axes[:, 0] if (axes[1, 0], axes[0, 0]) > (0, 0) else -axes[:, 0]
    lengths = np.linalg.norm(normal[:2]), np.linalg.norm(normal[2:])
    if min(lengths) == 0:
        return None
    across = np.einsum("i,fip->fp", normal, centred) ** 2
    seen = np.isfinite(across)
    sums = np.where(seen, across, 0).sum(0)
    with np.errstate(invalid="ignore"):
        point_rms = np.sqrt(np.where(seen.sum(0) >= FEWEST_FRAMES, sums / np.maximum(seen.sum(0), 1), np.nan))
    return ViewPair(
        first_axes=_axes(normal[:2] / lengths[0]), second_axes=_axes(-normal[2:] / lengths[1]),
        scale=float(lengths[0] / lengths[1]), spread=np.sqrt(np.maximum(square, 0)), point_rms=point_rms,
        settings=settings,
    )  # fmt: skip


def _axes(along: Floats) -> Floats:
    return np.array([[along[1], -along[0], 0.0], [along[0], along[1], 0.0], [0.0, 0.0, 1.0]])


def rows_of(camera_from_base: Floats, scale: Floats) -> Floats:
    """Stack the first two rows of scaled rotations (C, 3, 3) and (C,) to a projection (2C, 3)."""
    return np.asarray((scale[:, None, None] * camera_from_base[:, :2]).reshape(-1, 3))


def place_camera(tracks: Floats, shapes: Floats) -> tuple[Floats, float] | None:
    """Estimate rotation and scale of a camera from its image of known shapes, with a free shift in each frame.

    Args:
        tracks: (F, 2, P); NaN where not seen.
        shapes: (F, 3, P); NaN where not known.

    Returns:
        Rotation camera from shapes (3, 3) and scale; None where the camera sees too little of them.
    """
    both: Mask = np.asarray(np.isfinite(tracks).all(1) & np.isfinite(shapes).all(1))
    both[both.sum(1) < FEWEST_POINTS] = False
    count = both.sum(1)
    if (count > 0).sum() < FEWEST_FRAMES:
        return None
    weight = both[:, None].astype(float)
    number = np.maximum(count, 1)[:, None, None]
    known, seen = np.nan_to_num(shapes), np.nan_to_num(tracks)
    known = (known - (known * weight).sum(2, keepdims=True) / number) * weight
    seen = (seen - (seen * weight).sum(2, keepdims=True) / number) * weight
    normal = np.einsum("fip,fjp->ij", known, known)
    rows = np.linalg.solve(normal, np.einsum("fip,fjp->ij", known, seen)).T
    u, stretch, vt = np.linalg.svd(rows, full_matrices=False)
    rows = u @ vt
    return np.concatenate([rows, np.cross(rows[0], rows[1])[None]]), float(stretch.mean())
