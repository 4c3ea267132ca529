"""Edges between pixels as pieces of an outline: what the image is like on both sides, and what that makes them cost."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from marey.arrays import Floats, Mask, freeze_fields
from marey.kernels import kernel
from marey.knee.outlines.wire_tree import MOST_COST, Costs

FEATURES = ("inside", "outside", "across", "magnitude")
"""Intensity on the left and on the right of a step; how it rises to the right, and in whatever direction, per mm."""
_BLUR_PIXELS = 1.0
_BLUR_MM = 0.6
"""Standard deviation of the smoothing before features are measured: the smaller of the two."""
_REACH_MM = 0.7
"""So far from the edge its inside and outside are read, a pixel at least."""
_FLOOR = 0.05
"""What a step costs at least, as a share of the most: of two outlines as good the shorter one is taken."""
_BORDER = 0.15
"""What a step along the border of the slice costs, as such a share."""
_CLEAR = 1.5
"""Gradients of so many times the usual one are as much edge as not, before anything is learned."""
_QUANTILES = 21
_RARITY = 4.0
"""Logarithm of the odds against a step being on an outline, before its features are looked at."""
_FEWEST = 40
_SPREAD = 1.5
"""Classes over which counts are smoothed: standard deviation."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BoundaryElements:
    """The steps along the edges between the pixels of a slice, after [Falcao1998]: oriented, the inside to the left.

    Left as one sees a slice whose rows go down and whose columns go to the right: an outline goes against the clock.
    """

    features: NDArray[np.float32]
    """(rows + 1, columns + 1, 4, 4): of the steps from each corner to the right, down, to the left and up, the
    `FEATURES`; NaN where there is no step."""
    spacing_mm: tuple[float, float]
    """Of rows, and of columns."""

    def __post_init__(self) -> None:
        freeze_fields(self, "features", dtype=np.float32)

    @cached_property
    def usual(self) -> NDArray[np.float32]:
        """(N, 4) features of steps spread over the slice."""
        some = self.features[1:-1:2, 1:-1:2].reshape(-1, len(FEATURES))
        return some[np.isfinite(some).all(axis=1)]

    def around(self, mask: Mask) -> NDArray[np.float32]:
        """Return the features (N, 4) of the steps round what a mask (rows, columns) marks; at the border it goes on."""
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
    """How much likelier each value of each feature is on an outline than anywhere else."""

    ends: Floats
    """(4, B + 1) of the classes of values of each feature, ascending."""
    log_odds: Floats
    """(4, B)."""

    def __post_init__(self) -> None:
        freeze_fields(self, "ends", "log_odds")


def boundary_elements(image: Floats, spacing_mm: tuple[float, float]) -> BoundaryElements:
    """Measure the features of all steps in a slice.

    Args:
        image: (rows, columns).
        spacing_mm: Of rows, and of columns; they may differ.
    """
    blur = [min(_BLUR_PIXELS, _BLUR_MM / spacing) for spacing in spacing_mm]
    smooth = ndimage.gaussian_filter(np.asarray(image, np.float32), blur, mode="nearest")
    rows, columns = smooth.shape
    features = np.full((rows + 1, columns + 1, 4, len(FEATURES)), np.nan, np.float32)
    above, below = _from_both_sides(smooth, spacing_mm)
    features[:, :-1, 0], features[:, 1:, 2] = above, below
    # With rows and columns exchanged a step down is one to the right.
    left, right = (seen.swapaxes(0, 1) for seen in _from_both_sides(smooth.T, spacing_mm[::-1]))
    features[:-1, :, 1], features[1:, :, 3] = right, left
    return BoundaryElements(features=features, spacing_mm=(float(spacing_mm[0]), float(spacing_mm[1])))


def learned_costs(examples: Sequence[tuple[BoundaryElements, Mask]]) -> LearnedCosts | None:
    """Learn from examples what steps of an outline look like, beside the other steps of the same slices.

    Unlike the paper, which gives each feature a Gaussian about its mean on the example, both sides of an edge may be of
    several kinds here (cartilage here, fat there): each feature's values are counted on and off the outline.

    Args:
        examples: Slices, each with the pixels (rows, columns) that were outlined or painted.

    Returns:
        None where the examples' outlines have fewer than `_FEWEST` steps in all.
    """
    on = np.concatenate([np.zeros((0, len(FEATURES))), *(each.around(mask) for each, mask in examples)])
    if len(on) < _FEWEST:
        return None
    off = np.concatenate([each.usual for each, _ in examples])
    share = np.linspace(0, 1, _QUANTILES)
    ends = np.sort(np.concatenate([np.quantile(on, share, axis=0), np.quantile(off, share, axis=0)]), axis=0).T
    log_odds = np.array([_log_odds(on[:, i], off[:, i], ends[i]) for i in range(len(FEATURES))])
    return LearnedCosts(ends=ends, log_odds=log_odds)


def step_costs(elements: BoundaryElements, learned: LearnedCosts | None = None) -> Costs:
    """Return each step its cost: small on an outline, in proportion to its length in mm.

    Args:
        elements: The steps.
        learned: From examples. Without them an edge is as good as it stands out of the noise, whatever its direction.

    Returns:
        (rows + 1, columns + 1, 4) whole numbers as `WireTree` wants them. Along the slice's border, where a bone is cut
        off, an outline may go in one direction only, and at a low price.
    """
    features = elements.features
    if learned is None:
        clear = max(_CLEAR * float(np.median(elements.usual[:, 3])), float(np.finfo(np.float32).tiny))
        unlikely = 1 / (1 + (features[..., 3] / clear) ** 2)
    else:
        unlikely = np.empty(features.shape[:3], np.float32)
        _unlikely(features.reshape(-1, 4), learned.ends, learned.log_odds, unlikely.reshape(-1))
    row_mm, column_mm = elements.spacing_mm
    length = np.array([column_mm, row_mm, column_mm, row_mm]) / max(row_mm, column_mm)
    share = _FLOOR + (1 - _FLOOR) * np.where(np.isfinite(features[..., 0]), unlikely, 0)
    costs = np.clip(np.rint(share * length * MOST_COST), 1, MOST_COST).astype(np.int32)
    _close_border(costs, np.maximum(np.rint(_BORDER * length * MOST_COST), 1).astype(np.int32))
    return costs


def _from_both_sides(smooth: np.ndarray, spacing_mm: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """(rows + 1, columns, 4) features of the edges between pixels above each other: inside above, and inside below."""
    reach = max(1, round(_REACH_MM / spacing_mm[0]))
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


def _log_odds(on: Floats, off: Floats, ends: Floats) -> Floats:
    """(B,) logarithm of how much likelier each class is on an outline; smoothed over neighbouring classes."""
    counts = np.array([np.histogram(each, ends)[0] for each in (on, off)]) + 1.0
    shares = ndimage.gaussian_filter1d(counts, _SPREAD, axis=1, mode="nearest")
    shares /= shares.sum(axis=1, keepdims=True)
    return np.asarray(np.log(shares[0]) - np.log(shares[1]))


@kernel
def _unlikely(features, ends, log_odds, out):  # type: ignore[no-untyped-def]
    """Probability that a step is not on an outline: the features' odds taken together, and how rare outlines are."""
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
    """Let steps along the slice's border go only with the slice to their left."""
    costs[0, :, 0], costs[-1, :, 2], costs[:, 0, 3], costs[:, -1, 1] = 0, 0, 0, 0
    costs[0, 1:, 2], costs[-1, :-1, 0], costs[:-1, 0, 1], costs[1:, -1, 3] = border[2], border[0], border[1], border[3]
    # No step leads out.
    costs[:, -1, 0], costs[-1, :, 1], costs[:, 0, 2], costs[0, :, 3] = 0, 0, 0, 0
