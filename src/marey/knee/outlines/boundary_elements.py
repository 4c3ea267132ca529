"""Steps along the edges between pixels: features of the image on both sides, and their costs in an outline."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from marey.arrays import Floats, Mask, freeze_fields
from marey.compiled.kernels import kernel
from marey.knee.outlines.wire_tree import MOST_COST, Costs

FEATURES = ("inside", "outside", "across", "magnitude")
"""Intensity on the left and on the right of a step; its increase to the right, and in any direction, per mm."""
_RARITY = 4.0
"""Prior log odds against a step being on an outline; chosen by hand."""


@dataclass(frozen=True, kw_only=True)
class BoundarySettings:
    """Settings for the features and costs of steps between pixels.

    Values without a stated source were chosen by hand.
    """

    blur_pixels: float = 1.0
    """Largest standard deviation [px] of the smoothing before features are measured."""
    blur_mm: float = 0.6
    """Largest standard deviation [mm] of that smoothing."""
    reach_mm: float = 0.7
    """Distance [mm] from the edge, at least one pixel, at which its inside and outside are read."""
    least_cost: float = 0.05
    """Least cost of a step, as a share of the largest: of two equally good outlines the shorter one is taken."""
    border_cost: float = 0.15
    """Cost of a step along the border of the slice, as a share of the largest."""
    clear: float = 1.5
    """Multiple of the median gradient at which a step is as likely on an edge as not, before costs are learned."""
    quantiles: int = 21
    """Number of quantiles of each feature on and off outlines that bound its classes."""
    fewest_steps: int = 40
    """Fewest steps of outlines from which costs are learned."""
    class_smoothing: float = 1.5
    """Standard deviation, in classes, of the smoothing of counts."""


BOUNDARY_DEFAULTS = BoundarySettings()
"""Default settings for the features and costs of steps between pixels."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BoundaryElements:
    """The steps along the edges between the pixels of a slice, after [Falcao1998]: oriented, the inside to the left.

    With rows downward and columns to the right, an outline is counter-clockwise.
    """

    features: NDArray[np.float32]
    """(rows + 1, columns + 1, 4, 4): of the steps from each corner to the right, down, to the left and up, the
    `FEATURES`; NaN where there is no step."""
    spacing_mm: tuple[float, float]
    """Spacing of rows and of columns."""

    def __post_init__(self) -> None:
        freeze_fields(self, "features", dtype=np.float32)

    @cached_property
    def usual(self) -> NDArray[np.float32]:
        """(N, 4) features of a sample of steps over the slice."""
        some = self.features[1:-1:2, 1:-1:2].reshape(-1, len(FEATURES))
        return some[np.isfinite(some).all(axis=1)]

    def around(self, mask: Mask) -> NDArray[np.float32]:
        """Return the features (N, 4) of the steps around a mask (rows, columns), which continues beyond the border."""
        here, below, beside = mask[:-1], mask[1:], mask[:, 1:]
        right, left = here & ~below, below & ~here
        down, up = beside & ~mask[:, :-1], mask[:, :-1] & ~beside
        # The inside lies above a step to the right, and to the right of a step down.
        return np.concatenate([
            self.features[1:-1, :-1, 0][right],
            self.features[1:-1, 1:, 2][left],
            self.features[:-1, 1:-1, 1][down],
            self.features[1:, 1:-1, 3][up],
        ])  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class LearnedCosts:
    """Log odds of each value of each feature on an outline relative to elsewhere."""

    ends: Floats
    """(4, B + 1) bounds of the classes of each feature, ascending."""
    log_odds: Floats
    """(4, B) log odds of each class."""

    def __post_init__(self) -> None:
        freeze_fields(self, "ends", "log_odds")


def boundary_elements(
    image: Floats, spacing_mm: tuple[float, float], *, settings: BoundarySettings = BOUNDARY_DEFAULTS
) -> BoundaryElements:
    """Measure the features of all steps in a slice.

    Args:
        image: (rows, columns).
        spacing_mm: Spacing of rows and of columns; they may differ.
        settings: Tuned constants of the algorithm.
    """
    blur = [min(settings.blur_pixels, settings.blur_mm / spacing) for spacing in spacing_mm]
    smooth = ndimage.gaussian_filter(np.asarray(image, np.float32), blur, mode="nearest")
    rows, columns = smooth.shape
    features = np.full((rows + 1, columns + 1, 4, len(FEATURES)), np.nan, np.float32)
    above, below = _from_both_sides(smooth, spacing_mm, settings=settings)
    features[:, :-1, 0], features[:, 1:, 2] = above, below
    # With rows and columns exchanged, a step down is a step to the right.
    left, right = (seen.swapaxes(0, 1) for seen in _from_both_sides(smooth.T, spacing_mm[::-1], settings=settings))
    features[:-1, :, 1], features[1:, :, 3] = right, left
    return BoundaryElements(features=features, spacing_mm=(float(spacing_mm[0]), float(spacing_mm[1])))


def learned_costs(
    examples: Sequence[tuple[BoundaryElements, Mask]], *, settings: BoundarySettings = BOUNDARY_DEFAULTS
) -> LearnedCosts | None:
    """Learn the features of steps on outlines, relative to the other steps of the same slices, from examples.

    Unlike the paper, which gives each feature a Gaussian about its mean on the example, both sides of an edge may be of
    several kinds here (cartilage in places, fat in others): the values of each feature are counted on and off outlines.

    Args:
        examples: Slices, each with the mask (rows, columns) of outlined or painted pixels.
        settings: Tuned constants of the algorithm.

    Returns:
        None where the examples' outlines have fewer than `fewest_steps` steps in total.
    """
    on = np.concatenate([np.zeros((0, len(FEATURES))), *(each.around(mask) for each, mask in examples)])
    if len(on) < settings.fewest_steps:
        return None
    off = np.concatenate([each.usual for each, _ in examples])
    share = np.linspace(0, 1, settings.quantiles)
    ends = np.sort(np.concatenate([np.quantile(on, share, axis=0), np.quantile(off, share, axis=0)]), axis=0).T
    log_odds = np.array([_log_odds(on[:, i], off[:, i], ends[i], settings=settings) for i in range(len(FEATURES))])
    return LearnedCosts(ends=ends, log_odds=log_odds)


def step_costs(
    elements: BoundaryElements, learned: LearnedCosts | None = None, *, settings: BoundarySettings = BOUNDARY_DEFAULTS
) -> Costs:
    """Return the cost of each step: small on an outline, proportional to its length in mm.

    Args:
        elements: The steps.
        learned: Features learned from examples. Without them the cost depends on the gradient relative to the noise,
            in any direction.
        settings: Tuned constants of the algorithm.

    Returns:
        (rows + 1, columns + 1, 4) integers as `WireTree` expects them. Along the slice's border, where a bone is cut
        off, steps have one direction only, and a low cost.
    """
    features = elements.features
    if learned is None:
        clear = max(settings.clear * float(np.median(elements.usual[:, 3])), float(np.finfo(np.float32).tiny))
        unlikely = 1 / (1 + (features[..., 3] / clear) ** 2)
    else:
        unlikely = np.empty(features.shape[:3], np.float32)
        _unlikely(features.reshape(-1, 4), learned.ends, learned.log_odds, unlikely.reshape(-1))
    row_mm, column_mm = elements.spacing_mm
    length = np.array([column_mm, row_mm, column_mm, row_mm]) / max(row_mm, column_mm)
    share = settings.least_cost + (1 - settings.least_cost) * np.where(np.isfinite(features[..., 0]), unlikely, 0)
    costs = np.clip(np.rint(share * length * MOST_COST), 1, MOST_COST).astype(np.int32)
    _close_border(costs, np.maximum(np.rint(settings.border_cost * length * MOST_COST), 1).astype(np.int32))
    return costs


def _from_both_sides(
    smooth: np.ndarray, spacing_mm: Sequence[float], *, settings: BoundarySettings
) -> tuple[np.ndarray, np.ndarray]:
    """(rows + 1, columns, 4) features of the edges between vertical neighbours: with the inside above, and below."""
    reach = max(1, round(settings.reach_mm / spacing_mm[0]))
    padded = np.pad(smooth, ((reach, reach), (1, 1)), mode="edge")
    rows, columns = smooth.shape

    def shifted(down: int, right: int = 0) -> np.ndarray:
        part: np.ndarray = padded[reach + down :, 1 + right :][: rows + 1, :columns]
        return part

    across = (shifted(0) - shifted(-1)) / spacing_mm[0]
    beside = shifted(-1, 1) + shifted(0, 1) - shifted(-1, -1) - shifted(0, -1)
    magnitude = np.hypot(across, beside / (4 * spacing_mm[1]))
    above, below = shifted(-reach), shifted(reach - 1)
    return np.stack([above, below, across, magnitude], -1), np.stack([below, above, -across, magnitude], -1)


def _log_odds(on: Floats, off: Floats, ends: Floats, *, settings: BoundarySettings) -> Floats:
    """(B,) log odds of each class on an outline; smoothed over neighbouring classes."""
    counts = np.array([np.histogram(each, ends)[0] for each in (on, off)]) + 1.0
    shares = ndimage.gaussian_filter1d(counts, settings.class_smoothing, axis=1, mode="nearest")
    shares /= shares.sum(axis=1, keepdims=True)
    return np.asarray(np.log(shares[0]) - np.log(shares[1]))


@kernel
def _unlikely(features, ends, log_odds, out):  # type: ignore[no-untyped-def]
    """Write the probability that a step is not on an outline: by the odds of its features, and the prior odds."""
    for step in range(len(features)):
        total = -_RARITY
        for feature in range(features.shape[1]):
            value = features[step, feature]
            low, high = 0, log_odds.shape[1] - 1
            while low < high:
                middle = (low + high + 1) // 2
                if ends[feature, middle] <= value:
                    low = middle
                else:
                    high = middle - 1
            total += log_odds[feature, low]
        out[step] = 1 / (1 + np.exp(total))


def _close_border(costs: Costs, border: NDArray[np.int32]) -> None:
    """Allow steps along the slice's border only with the slice to their left."""
    costs[0, :, 0], costs[-1, :, 2], costs[:, 0, 3], costs[:, -1, 1] = 0, 0, 0, 0
    costs[0, 1:, 2], costs[-1, :-1, 0], costs[:-1, 0, 1], costs[1:, -1, 3] = border[2], border[0], border[1], border[3]
    # No step leaves the slice.
    costs[:, -1, 0], costs[-1, :, 1], costs[:, 0, 2], costs[0, :, 3] = 0, 0, 0, 0
