"""Assignment of contour pixels to one of two equally near limbs, by a vote of their neighbours."""

import numpy as np

from marey.compiled.kernels import kernel
from marey.images.silhouettes.nearest import CELL

SLACK = 2.0
"""A second limb's rim counts as equally near if it is farther by less than this [px]. Chosen by hand."""
SPLIT = 4.0
"""Rim points nearer to each other than this are one place, even if they belong to different limbs [px]. Chosen by
hand."""
WINDOW = 10.0
"""Radius along the outline within which neighbours vote [px]. Chosen by hand."""
ALONG = 0.7
"""Least cosine between normals of voting neighbours; others are on another side of a limb. Chosen by hand."""


@kernel
def elect_limbs(nearest, second, rim, limb, contour, inward):
    """Decide by vote which rim pixel each contour pixel is matched with, where two limbs are equally near.

    Neighbours along the outline vote if they are unambiguous; without a majority the pixel is not matched. Ours:
    [Rosenhahn2006] section 2.2 mentions the vote without its rule.

    Args:
        nearest: (m,) each pixel's nearest rim pixel, -1 for none.
        second: (m,) the nearest one of another limb if it is equally near, else -1.
        rim: (n, 2).
        limb: (n,) of the rim pixels.
        contour: The outline's `Cells`.
        inward: (m, 2) its normals.

    Returns:
        (m,) the rim pixel for each pixel, -1 for none, and (m,) true for pixels that were ambiguous.
    """
    ambiguous = np.zeros(len(nearest), np.bool_)
    for j in range(len(nearest)):
        if second[j] >= 0:
            dx = rim[nearest[j], 0] - rim[second[j], 0]
            dy = rim[nearest[j], 1] - rim[second[j], 1]
            ambiguous[j] = dx * dx + dy * dy > SPLIT * SPLIT
    taken = nearest.copy()
    for j in range(len(nearest)):
        if ambiguous[j]:
            votes, own, other = count_votes(j, nearest, second, ambiguous, limb, contour, inward)
            if 2 * other > votes:
                taken[j] = second[j]
            elif 2 * own <= votes:
                taken[j] = -1
    return taken, ambiguous


@kernel
def count_votes(j, nearest, second, ambiguous, limb, contour, inward):
    """Count a pixel's unambiguous neighbours, and those among them of its nearest and its second limb."""
    votes = own = other = 0
    x, y = contour.pixels[j, 0], contour.pixels[j, 1]
    top, left = int(np.floor(y - WINDOW - contour.top)) // CELL, int(np.floor(x - WINDOW - contour.left)) // CELL
    bottom, right = int(np.floor(y + WINDOW - contour.top)) // CELL, int(np.floor(x + WINDOW - contour.left)) // CELL
    for row in range(max(top, 0), min(bottom + 1, contour.rows)):
        for column in range(max(left, 0), min(right + 1, contour.columns)):
            cell = row * contour.columns + column
            for n in range(contour.first[cell], contour.first[cell + 1]):
                k = contour.order[n]
                dx, dy = contour.pixels[k, 0] - x, contour.pixels[k, 1] - y
                along = inward[j, 0] * inward[k, 0] + inward[j, 1] * inward[k, 1]
                if ambiguous[k] or nearest[k] < 0 or dx * dx + dy * dy > WINDOW * WINDOW or along < ALONG:
                    continue
                votes += 1
                own += limb[nearest[k]] == limb[nearest[j]]
                other += limb[nearest[k]] == limb[second[j]]
    return votes, own, other
