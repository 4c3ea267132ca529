"""Cost of a pose from the distances between its outlines and the silhouettes, by which different poses are compared."""

from collections.abc import Sequence

import numpy as np

from marey.body.articulation.pose import PosedBody
from marey.fit.search.levels import SilhouetteLevel
from marey.fit.solver.picture_times import PictureMotion
from marey.images.silhouettes.contours import SilhouetteContour, trace_contour
from marey.images.silhouettes.nearest import nearest_within
from marey.kernels import kernel
from marey.observations.correspondence import view_of
from marey.observations.prior import Habit, JointLimits


def outline_cost(
    posed: PosedBody, level: SilhouetteLevel, *, scale: float, sigma_px: float,
    motions: Sequence[PictureMotion] | None = None,
) -> float:  # fmt: skip
    """Return half the robust sum of squares of the distances between the outlines of a body and the silhouettes.

    Each pixel of either outline counts, in units of the standard deviation of a match, and one that is far from the
    other outline with the limit of the robust function, whose weights the refinement uses.

    Args:
        posed: The body.
        level: Silhouettes of a frame; where the image's border or something in front cuts them is no outline.
        scale: Scale of the robust function [px].
        sigma_px: Standard deviation of a match [px].
        motions: Known motion of the body until each camera's picture; None if all pictures are of the frame's instant.
    """
    total = 0.0
    for c, sighting in enumerate(level.sightings):
        seen = posed if motions is None else motions[c].after(posed)
        drawn = trace_contour(view_of(seen, sighting.camera).mask())
        total += _distances(drawn, sighting.contour, scale) + _distances(sighting.contour, drawn, scale)
    return 0.5 * total / sigma_px**2


def _distances(first: SilhouetteContour, second: SilhouetteContour, scale: float) -> float:
    """Return the sum over a contour's pixels of the robust squared distances from another contour [px2]."""
    if len(second.pixels) == 0:
        return len(first.pixels) * scale**2
    return float(_robust_sum(np.ascontiguousarray(first.pixels), second.cells, scale)) if len(first.pixels) else 0.0


@kernel
def _robust_sum(pixels, cells, scale):
    """Add s^2 r^2 / (s^2 + r^2) for the distances r of pixels (n, 2) from the nearest one in cells, at scale s."""
    total = 0.0
    for i in range(pixels.shape[0]):
        x, y = pixels[i, 0], pixels[i, 1]
        j = nearest_within(cells, x, y, 5.0 * scale)
        if j < 0:
            total += scale**2
            continue
        square = (cells.pixels[j, 0] - x) ** 2 + (cells.pixels[j, 1] - y) ** 2
        total += scale**2 * square / (scale**2 + square)
    return total


def prior_cost(posed: PosedBody, *, habit: float) -> float:
    """Return half the sum of squares of the joint limits and of the usual angles, the latter of weight `habit`."""
    total = 0.0
    for prior in (JointLimits(), Habit(share=habit)):
        residual, _ = prior.by_angle(posed)
        total += 0.5 * float(np.sum((residual / prior.sigma) ** 2))
    return total
