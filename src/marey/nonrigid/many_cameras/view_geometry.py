"""What two cameras that stand fixed share of a deforming object's tracks, and how another one stands.

Two orthographic cameras share one direction, across both sights: what they show along it is the same but for the
scale, whatever the object does. That gives each camera's roll about its sight and the scale, and leaves one angle, that
between the sights, which no number of frames gives as long as each may have a shape of its own ([Koenderink1991]).
"""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.geometry import rotations

FEWEST_POINTS = 4
FEWEST_FRAMES = 6
OUTLYING = 6.0
"""A point that lies so many times further from the shared direction than the median point has no true partner..."""
FAR = 0.01
"""...and at least this share of the object's size."""
ROUNDS = 5
SET, SETS = 6, 40
"""Points of a small set, and how many sets are tried, see `_agreeing`."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewPair:
    """What the tracks tell of two cameras: all but the angle between their sights, and which mirror image is true."""

    first_axes: Floats
    """(3, 3) rows: across the shared direction in the first image, along it, and the sight, in the first camera."""
    second_axes: Floats
    """(3, 3) the same of the second camera."""
    scale: float
    """Of the second camera over the first."""
    spread: Floats
    """(4,) root mean squares of the four stacked coordinates along their principal axes, rising: the first is noise,
    the second what the cameras see differently."""
    point_rms: Floats
    """(P,) root mean square of what a point departs along the shared direction; NaN where not seen by both."""

    def __post_init__(self) -> None:
        freeze_fields(self, "first_axes", "second_axes", "spread", "point_rms")

    def second_from_first(self, angle: float) -> Floats:
        """Give the rotation (3, 3) with an angle [rad] between the sights; the mirror image has minus the angle."""
        return np.asarray(self.second_axes.T @ rotations.exp(np.array([0.0, angle, 0.0])) @ self.first_axes)

    @property
    def outlying(self) -> Mask:
        """(P,) points whose two tracks cannot be of one point."""
        if not np.isfinite(self.point_rms).any():
            return np.zeros(len(self.point_rms), bool)
        least = max(OUTLYING * float(np.nanmedian(self.point_rms)), FAR * float(self.spread[3]))
        return np.asarray(self.point_rms > least)


def pair_of(first: Floats, second: Floats) -> ViewPair | None:
    """Find what two cameras share, points without a true partner left out.

    Args:
        first: (F, 2, P) tracks in the first camera; NaN where not seen.
        second: (F, 2, P) those of the same points in the second.

    Returns:
        The pair; None where too few points are seen by both in too few frames.
    """
    stacked = np.concatenate([first, second], 1)
    both = np.isfinite(stacked).all(1)
    often = both.sum(0) >= FEWEST_FRAMES
    used = _agreeing(stacked, both, often)
    for _ in range(ROUNDS):
        pair = _pair(stacked, both & used)
        if pair is None:
            return None
        kept = often & ~pair.outlying
        if (kept == used).all():
            break
        used = kept
    return pair


def _agreeing(stacked: Floats, both: Mask, often: Mask) -> Mask:
    """Choose the points that agree with the best of some small sets: a wrong partner would bend the fit to all."""
    numbers = np.flatnonzero(often)
    if len(numbers) <= SET:
        return often
    rng = np.random.default_rng(0)
    best, used = np.inf, often
    for _ in range(SETS):
        chosen = np.zeros(len(often), bool)
        chosen[rng.choice(numbers, SET, replace=False)] = True
        pair = _pair(stacked, both & chosen)
        if pair is None:
            continue
        middle = float(np.nanmedian(pair.point_rms))
        if middle < best:
            best, used = middle, often & ~pair.outlying
    return used


def along_one_direction(first: Floats, second: Floats) -> ViewPair | None:
    """Find what two cameras share, as `pair_of` does, but with all points."""
    stacked = np.concatenate([first, second], 1)
    return _pair(stacked, np.asarray(np.isfinite(stacked).all(1)))


def _pair(stacked: Floats, used: Mask) -> ViewPair | None:
    enough = used.sum(1) >= FEWEST_POINTS
    if enough.sum() < FEWEST_FRAMES:
        return None
    weight = np.where(enough[:, None], used, False).astype(float)
    middle = (np.nan_to_num(stacked) * weight[:, None]).sum(2) / np.maximum(weight.sum(1), 1)[:, None]
    middle[~enough] = np.nan
    centred = stacked - middle[:, :, None]
    left = np.nan_to_num(centred) * weight[:, None]
    # centring takes a coordinate a frame
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
    )  # fmt: skip


def _axes(along: Floats) -> Floats:
    return np.array([[along[1], -along[0], 0.0], [along[0], along[1], 0.0], [0.0, 0.0, 1.0]])


def rows_of(camera_from_base: Floats, scale: Floats) -> Floats:
    """Stack the first two rows of scaled rotations (C, 3, 3) and (C,) to a projection (2C, 3)."""
    return np.asarray((scale[:, None, None] * camera_from_base[:, :2]).reshape(-1, 3))


def place_camera(tracks: Floats, shapes: Floats) -> tuple[Floats, float] | None:
    """Find the rotation and scale with which a camera shows known shapes, each frame with a shift of its own.

    Args:
        tracks: (F, 2, P); NaN where not seen.
        shapes: (F, 3, P); NaN where not known.

    Returns:
        Camera from shapes (3, 3) and the scale; None where it sees too little of them.
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
