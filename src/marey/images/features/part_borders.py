"""Borders between parts of the body inside its silhouette, from the densities of their colours."""

import cv2
import numpy as np

from marey.arrays import Floats, Image, Integers, Mask
from marey.compiled.kernels import kernel
from marey.images.features.part_evidence import colour_cells
from marey.images.silhouettes.densities import COLOUR_SHIFT
from marey.images.silhouettes.interior import SIDE_WIDTH, InteriorEdges, edge_reach, free_way
from marey.images.silhouettes.part_colours import PartColours

ASIDE = 4.0
"""Distance from a rim at which the drawn body shows the part in front and the part behind [px]. Chosen by hand."""
DIFFERENT = 1.0
"""Least mean log-likelihood ratio of the two parts on each side of a border, for the part on that side. Of the borders
that have a clear step of colour, too, 91 to 95 % lie within 1.5 px of it on three takes, and 88 to 92 % with 0.5."""
RATIO_LIMIT = 4.0
"""Limit of a pixel's log-likelihood ratio. Chosen by hand."""
_ALONG = 2
"""Number of pixels along the border, to each side, over which the ratio is averaged. Chosen by hand."""


def part_borders(image: Image, mask: Mask, expected: InteriorEdges, parts: Integers, colours: PartColours) -> Floats:
    """Find where the colours of one part end and those of the part behind it begin, along the normals of rims.

    A bare forearm before a shirt has an inner outline. With the densities p of the part in front and q of the part
    behind, the offset of the border along the normal is the change point of largest likelihood: the pixels beyond it
    are assigned to p, those before it to q. Unlike a step of colour, the change point may lie in texture or shade.

    Args:
        image: (H, W, C) uint8.
        mask: (H, W) silhouette, within which borders are searched.
        expected: Rims of the predicted surface.
        parts: (H, W) part at each pixel of the drawn body; -1 outside.
        colours: Densities of the parts in this camera.

    Returns:
        (n,) offsets of the borders from the rims along their normals [px]; NaN where there is none, or where the
        colours of both sides are alike.
    """
    if len(expected) == 0 or not mask.any():
        return np.full(len(expected), np.nan)
    depth = cv2.distanceTransform(np.ascontiguousarray(mask).view(np.uint8), cv2.DIST_L2, 5)
    density = colours.density.reshape(len(colours.density), -1)
    offsets: Floats = _change_points(
        colour_cells(image, COLOUR_SHIFT), density, np.ascontiguousarray(parts), depth, expected.pixels,
        expected.inward, edge_reach(mask),
    )  # fmt: skip
    return offsets


@kernel
def _change_points(cells, density, parts, depth, pixels, inward, reach):
    found = np.full(len(pixels), np.nan)
    ratio = np.empty(2 * (reach + SIDE_WIDTH) + 1)
    for i in range(len(pixels)):
        front = _part_at(parts, pixels[i, 0] + ASIDE * inward[i, 0], pixels[i, 1] + ASIDE * inward[i, 1])
        behind = _part_at(parts, pixels[i, 0] - ASIDE * inward[i, 0], pixels[i, 1] - ASIDE * inward[i, 1])
        if front < 0 or behind < 0 or front == behind:
            continue
        first, last = free_way(depth, pixels[i, 0], pixels[i, 1], inward[i], reach + SIDE_WIDTH)
        if last - first < 2 * SIDE_WIDTH:
            continue
        along = ratio[: last - first + 1]
        _take_ratios(cells, density[front], density[behind], pixels[i], inward[i], first, along)
        found[i] = first + change_point(along, -reach - first, reach - first)
    return found


@kernel
def _part_at(parts, x, y):
    column, row = int(np.rint(x)), int(np.rint(y))
    inside = 0 <= row < parts.shape[0] and 0 <= column < parts.shape[1]
    return parts[row, column] if inside else -1


@kernel
def _take_ratios(cells, front, behind, pixel, normal, first, ratio):
    """Write the mean log-likelihood ratio of the parts in front and behind at each step along a normal."""
    height, width = cells.shape
    for s in range(len(ratio)):
        total = 0.0
        for t in range(-_ALONG, _ALONG + 1):
            x = int(np.rint(pixel[0] + (first + s) * normal[0] - t * normal[1]))
            y = int(np.rint(pixel[1] + (first + s) * normal[1] + t * normal[0]))
            cell = cells[min(max(y, 0), height - 1), min(max(x, 0), width - 1)]
            value = np.log(max(front[cell], 1e-30)) - np.log(max(behind[cell], 1e-30))
            total += min(max(value, -RATIO_LIMIT), RATIO_LIMIT)
        ratio[s] = total / (2 * _ALONG + 1)


@kernel
def change_point(ratio, first, last):
    """Return the step after which log-likelihood ratios (n,) change from negative to positive.

    Args:
        ratio: (n,) ratios at whole steps.
        first: First step at which the change may lie.
        last: Last step at which the change may lie.

    Returns:
        The change point, half a step before the first positive ratio; NaN if a side is not clear.
    """
    before, best, place = 0.0, -np.inf, -1
    total = ratio.sum()
    for s in range(len(ratio)):
        # Before step s the ratios count negatively, from it on positively.
        likelihood = total - 2.0 * before
        if first <= s - 0.5 <= last and SIDE_WIDTH <= s <= len(ratio) - SIDE_WIDTH and likelihood > best:
            best, place = likelihood, s
        before += ratio[s]
    if place < 0:
        return np.nan
    clear = ratio[place : place + SIDE_WIDTH].mean() >= DIFFERENT
    clear &= ratio[place - SIDE_WIDTH : place].mean() <= -DIFFERENT
    return place - 0.5 if clear else np.nan
