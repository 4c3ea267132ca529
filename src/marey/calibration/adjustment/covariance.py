"""Covariance of the cameras of an adjusted calibration."""

from collections.abc import Iterator

import numpy as np

from marey.arrays import Floats, Integers
from marey.calibration.adjustment.adjust import Adjusted
from marey.calibration.adjustment.equations import COMMON_COLUMNS, common_columns
from marey.calibration.adjustment.projection import BOARD_COLUMNS, RESIDUAL_COLUMN
from marey.calibration.adjustment.state import CAMERA
from marey.errors import SettingProblem

_UNSEEN = 1e-10
"""Eigenvalue of a pose's normal matrix, relative to the largest, below which nothing is known of it; by hand."""


def common_covariance(adjusted: Adjusted) -> Floats:
    """Return the covariance of the common unknowns.

    The inverse of the reduced normal matrix holds if the corners' errors are independent. Errors that the corners of a
    picture share (motion blur, a picture out of step, a lens that the model does not describe) make it too small.
    It is therefore multiplied by the ratio of the scatter of the pictures' contributions to the gradient to the
    scatter expected from independent errors, if that exceeds one. Distortion coefficients that are missing in the
    model of a lens, since the corners do not support them, are not certainly zero: what they would change is added.

    Args:
        adjusted: The solution.

    Returns:
        (16 C + 4, 16 C + 4), zero for unknowns that were not estimated and are no such coefficients.

    Raises:
        SettingProblem: The views that are used do not determine all unknowns.
    """
    free, inverse = adjusted.problem.free, free_covariance(adjusted)
    full = np.zeros((len(free), len(free)))
    full[np.ix_(free, free)] = inverse
    return full * max(1.0, picture_inflation(adjusted, inverse)) + _of_omitted(adjusted, inverse)


def free_covariance(adjusted: Adjusted) -> Floats:
    """Return the covariance (d, d) of the free common unknowns if the corners' errors are independent.

    Args:
        adjusted: The solution.

    Raises:
        SettingProblem: The views that are used do not determine all unknowns.
    """
    free = adjusted.problem.free
    return _inverse(adjusted.blocks.reduced()[0][np.ix_(free, free)])


def _of_omitted(adjusted: Adjusted, inverse: Floats) -> Floats:
    """Return what the missing coefficients x of the lenses add: those themselves and -S^-1 S_x x of all others."""
    problem = adjusted.problem
    added = np.zeros((len(problem.free), len(problem.free)))
    matrix = adjusted.blocks.reduced()[0] if problem.omitted.any() else added
    for camera, products in enumerate(problem.omitted):
        missing = CAMERA * camera + np.flatnonzero(np.diag(products))
        if len(missing):
            slope = np.zeros((len(added), len(missing)))
            slope[problem.free] = -inverse @ matrix[np.ix_(problem.free, missing)]
            slope[missing, np.arange(len(missing))] = 1.0
            own = missing - CAMERA * camera
            added += slope @ products[np.ix_(own, own)] @ slope.T
    return added


def _inverse(matrix: Floats) -> Floats:
    """Return the inverse of a symmetric matrix whose rows have different units."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    try:
        inverse = np.linalg.inv(matrix / size[:, None] / size)
    except np.linalg.LinAlgError as error:
        raise SettingProblem(
            "The views that agree with each other do not determine all cameras. Check that the pictures of one number "
            "show one instant in all cameras, and film the board before each of them again."
        ) from error
    return np.asarray(inverse / size[:, None] / size)


def picture_inflation(adjusted: Adjusted, inverse: Floats) -> float:
    """Return by what the variances exceed those of independent corners.

    With the gradient g_p of picture p, its share S_p of the reduced normal matrix S, and independent errors, the
    expectation of sum g_p^T S^-1 g_p is the sum of tr(S^-1 S_p) - tr((S^-1 S_p)^2).

    Args:
        adjusted: The solution.
        inverse: (d, d) inverse of the reduced normal matrix of the free unknowns.

    Returns:
        Observed over expected value; one if there is nothing to compare.
    """
    observed = expected = 0.0
    for _, own, gradient, share in picture_shares(adjusted):
        block = inverse[np.ix_(own, own)]
        product = block @ share
        observed += float(gradient @ block @ gradient)
        expected += float(np.trace(product) - np.sum(product * product.T))
    return observed / expected if expected > 0 else 1.0


def picture_shares(adjusted: Adjusted) -> Iterator[tuple[int, Integers, Floats, Floats]]:
    """Iterate over what each board pose contributes to the reduced equations of the free common unknowns.

    Args:
        adjusted: The solution.

    Yields:
        The pose, the indices (k,) of its unknowns among the free ones, gradient (k,), and matrix (k, k).
    """
    problem, cameras = adjusted.problem, adjusted.state.cameras
    position = np.cumsum(problem.free) - 1
    places = problem.views
    squares = adjusted.systems.square
    for pose in np.unique(places.pose):
        views = np.flatnonzero(places.pose == pose)
        prior = problem.place_sd[pose] ** -2.0
        pull = prior * (problem.place_mean[pose] - adjusted.state.board_translation[pose])
        index, gradient, share = _pose_share(
            squares[views], places.camera[views], cameras, bool(problem.fixed_pose[pose]), (prior, pull)
        )
        free = problem.free[index]
        yield int(pose), position[index[free]], gradient[free], share[np.ix_(free, free)]


def _pose_share(
    squares: Floats, camera: Integers, cameras: int, fixed: bool, place: tuple[float, Floats]
) -> tuple[Integers, Floats, Floats]:
    """Return what the views (v, 27, 27) of one board pose contribute to the equations of the common unknowns.

    What is known of its translation enters as the weight of its coordinates and the gradient (3,).

    Returns:
        Indices (k,) of the unknowns of their cameras, of the shape and of the delays, in ascending order, gradient
        (k,), and reduced normal matrix (k, k).
    """
    of_view = common_columns(camera, cameras)
    index, position = np.unique(of_view, return_inverse=True)
    position = position.reshape(of_view.shape)
    gradient, share = np.zeros(len(index)), np.zeros((len(index), len(index)))
    mixed, board = np.zeros((len(index), 6)), BOARD_COLUMNS
    for square, own in zip(squares, position, strict=True):
        gradient[own] += square[COMMON_COLUMNS, RESIDUAL_COLUMN]
        mixed[own] += square[COMMON_COLUMNS, board]
        share[np.ix_(own, own)] += square[np.ix_(COMMON_COLUMNS, COMMON_COLUMNS)]
    whole = squares.sum(axis=0)
    if not fixed:
        own, right = whole[board, board].copy(), whole[board, RESIDUAL_COLUMN].copy()
        own[3:, 3:] += place[0] * np.eye(3)
        right[3:] += place[1]
        # What no corner determines, as the rotation of a wand about its stick, couples to nothing.
        across = mixed @ np.linalg.pinv(own, rcond=_UNSEEN, hermitian=True)
        gradient, share = gradient - across @ right, share - across @ mixed.T
    return index, gradient, share
