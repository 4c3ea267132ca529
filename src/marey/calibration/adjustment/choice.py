"""Choice of the pictures that add most to what is known of the cameras.

The information of a set of pictures is the logarithm of the determinant of the reduced normal matrix, the sum of the
shares of its pictures. It is submodular: a picture adds the less, the more pictures there are already. So pictures
are chosen greedily, and a gain that was computed earlier is a bound ([Minoux1978]).
"""

import heapq

import numpy as np

from marey.arrays import Floats, Mask
from marey.calibration.adjustment.covariance import picture_shares
from marey.calibration.adjustment.solve import SolvedSession

_FIRST_INFORMATION = 1e-6
"""Share of the whole information with which the choice begins, so that the determinant is not zero; by hand."""
_NOTHING = 1e-10
"""Share of the whole information that is rounding only; chosen by hand."""


def informative_pictures(solved: SolvedSession, most: int) -> Mask:
    """Choose the pictures that add most to the information on lenses and poses.

    Args:
        solved: A solved session with all pictures.
        most: Number of pictures to choose.

    Returns:
        (F,) true for the chosen pictures; all that were used if they are no more than `most`.
    """
    problem = solved.adjusted.problem
    chosen = np.zeros(len(problem.corners.pictures), bool)
    used = np.unique(problem.corners.picture)
    if len(used) <= most:
        chosen[used] = True
        return chosen
    roots = _roots(solved)
    covariance = np.eye(int(problem.free.sum())) / _FIRST_INFORMATION
    heap = [(-_gain(covariance, root), picture, 0) for picture, root in roots.items()]
    heapq.heapify(heap)
    for step in range(1, most + 1):
        picture = _best(heap, roots, covariance, step)
        if picture is None:
            break
        chosen[picture] = True
        across = covariance @ roots[picture]
        inner = np.eye(across.shape[1]) + roots[picture].T @ across
        covariance = covariance - across @ np.linalg.solve(inner, across.T)
    return chosen


def _roots(solved: SolvedSession) -> dict[int, Floats]:
    """Return for each picture R (d, r) with R R^T its information, in unknowns in which the whole is the unit matrix.

    In their own units, pixels and metres, the unknowns differ by many orders of magnitude.
    """
    problem = solved.adjusted.problem
    matrix = solved.adjusted.blocks.reduced()[0][np.ix_(problem.free, problem.free)]
    size = np.sqrt(np.diag(matrix))
    white = np.linalg.inv(np.linalg.cholesky(matrix / size[:, None] / size)) / size
    picture_of = {int(problem.pose[picture]): int(picture) for picture in np.unique(problem.corners.picture)}
    roots = {}
    for pose, index, _, share in picture_shares(solved.adjusted):
        own = white[:, index]
        values, vectors = np.linalg.eigh(own @ share @ own.T)
        good = values > _NOTHING
        roots[picture_of[pose]] = np.asarray(vectors[:, good] * np.sqrt(values[good]))
    return roots


def _best(
    heap: list[tuple[float, int, int]], roots: dict[int, Floats], covariance: Floats, step: int
) -> int | None:
    """Take the picture of the greatest gain from a heap of bounds, each with the step at which it was computed."""
    while heap:
        _, picture, known = heapq.heappop(heap)
        if known == step:
            return picture
        heapq.heappush(heap, (-_gain(covariance, roots[picture]), picture, step))
    return None


def _gain(covariance: Floats, root: Floats) -> float:
    """Return by how much a picture increases the logarithm of the determinant: log det(I + R^T C R)."""
    return float(np.linalg.slogdet(np.eye(root.shape[1]) + root.T @ covariance @ root)[1])
