"""Which limb a pixel of an outline belongs to where two are equally near: its neighbours vote."""

import numpy as np

from marey.images.silhouettes.nearest import CELL
from marey.kernels import kernel

SLACK = 2.0
"""A second limb's rim that is farther by less than this is as good as the nearest one [px]."""
SPLIT = 4.0
"""Rim points nearer to each other than this are one place, whoever they belong to [px]."""
WINDOW = 10.0
"""How far along the outline neighbours vote [px]."""
ALONG = 0.7
"""Neighbours whose normals' cosine is less than this lie on another side of a limb."""


@kernel
def elect(nearest, second, rim, limb, contour, inward):
    """Decide by vote which rim pixel each of an outline's pixels takes, where two limbs are equally near.

    Those neighbours along the outline vote that have no such choice; without a majority the pixel takes none. Ours:
    [Rosenhahn2006] section 2.2 names the vote without its rule.

    Args:
        nearest: (m,) each pixel's nearest rim pixel, -1 for none.
        second: (m,) the nearest one of another limb where that is as good, -1 elsewhere.
        rim: (n, 2).
        limb: (n,) of the rim pixels.
        contour: the outline's `Cells`.
        inward: (m, 2) its normals.

    Returns:
        (m,) the rim pixel that each pixel takes, -1 for none, and (m,) true for those that were voted on.
    """
    doubtful = np.zeros(len(nearest), np.bool_)
    for j in range(len(nearest)):
        if second[j] >= 0:
            dx = rim[nearest[j], 0] - rim[second[j], 0]
            dy = rim[nearest[j], 1] - rim[second[j], 1]
            doubtful[j] = dx * dx + dy * dy > SPLIT * SPLIT
    taken = nearest.copy()
    for j in range(len(nearest)):
        if doubtful[j]:
            votes, own, other = count_votes(j, nearest, second, doubtful, limb, contour, inward)
            if 2 * other > votes:
                taken[j] = second[j]
            elif 2 * own <= votes:
                taken[j] = -1
    return taken, doubtful


@kernel
def count_votes(j, nearest, second, doubtful, limb, contour, inward):
    """Count the neighbours of a pixel that have a limb beyond doubt, and those of its nearest and its second limb."""
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
                if doubtful[k] or nearest[k] < 0 or dx * dx + dy * dy > WINDOW * WINDOW or along < ALONG:
                    continue
                votes += 1
                own += limb[nearest[k]] == limb[nearest[j]]
                other += limb[nearest[k]] == limb[second[j]]
    return votes, own, other
