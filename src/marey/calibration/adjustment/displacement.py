"""How far the boards that the cameras of a picture see are displaced from each other, estimated from their corners.

Cameras that are not exactly synchronous see a moving board in different poses. Each view v estimates the common
pose of its
picture by x_v with the covariance A_v^-1 of its corners; displacements of the standard deviations S make that
A_v^-1 + S^2. The restricted likelihood of the estimates x_v determines S, as in a meta-analysis with random effects
([Harville1977]).
"""

import numpy as np
import scipy.optimize

from marey.arrays import Floats, Integers
from marey.calibration.adjustment.projection import BOARD_COLUMNS, RESIDUAL_COLUMN
from marey.geometry.rotations import hat

_LEAST_GAIN = 12.0
"""Least gain of twice the logarithm of the likelihood by displacements: by chance once in 400 times for two numbers."""
_FIRST = (1e-3, 1e-3)
"""First standard deviations of rotation [rad] and translation [m] in the search; chosen by hand."""
_RANGE = (1e-6, 0.3)
"""Smallest and largest standard deviations of the search [rad] and [m]; chosen by hand."""
_WEAKEST = 1e-9
"""Smallest eigenvalue of a view's normal matrix, relative to the largest, with which it takes part; chosen by hand."""


def estimate_displacement(square: Floats, pose: Integers, arm: Floats) -> tuple[float, float]:
    """Estimate the standard deviations of the boards' displacements.

    Args:
        square: (V, 27, 27) products of each view's rows in standard deviations of its corners, without displacements.
        pose: (V,) board pose of each view.
        arm: (V, 3) from the board's origin to its centre, in world axes [m].

    Returns:
        Rotation [rad] and translation [m]; zeros where the views of each picture agree.
    """
    change = np.zeros((len(square), 6, 6))
    change[:, :3, :3] = change[:, 3:, 3:] = np.eye(3)
    change[:, 3:, :3] = hat(arm)
    normal = change.transpose(0, 2, 1) @ square[:, BOARD_COLUMNS, BOARD_COLUMNS] @ change
    right = (change.transpose(0, 2, 1) @ square[:, BOARD_COLUMNS, RESIDUAL_COLUMN, None])[..., 0]
    size = np.sqrt(np.maximum(np.einsum("vii->vi", normal), 1e-30))
    values = np.linalg.eigvalsh(normal / size[:, :, None] / size[:, None, :])
    good = values[:, 0] > _WEAKEST * values[:, -1]
    _, inverse, count = np.unique(pose[good], return_inverse=True, return_counts=True)
    several = count[inverse] > 1
    if not several.any():
        return 0.0, 0.0
    kept = np.flatnonzero(good)[several]
    group = np.unique(pose[kept], return_inverse=True)[1]
    own = np.linalg.inv(normal[kept])
    estimates = (own @ right[kept][..., None])[..., 0]
    return _most_likely(own, estimates, group)


def _most_likely(own: Floats, estimates: Floats, group: Integers) -> tuple[float, float]:
    low, high = np.log(_RANGE)

    def loss(logarithms: Floats) -> float:
        spread = np.exp(np.clip(logarithms, low, high))
        return _loss(own, estimates, group, spread)

    found = scipy.optimize.minimize(loss, np.log(_FIRST), method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.1})
    if _loss(own, estimates, group, np.zeros(2)) - float(found.fun) < _LEAST_GAIN:
        return 0.0, 0.0
    turn, shift = np.exp(np.clip(found.x, low, high))
    return float(turn), float(shift)


def _loss(own: Floats, estimates: Floats, group: Integers, spread: Floats) -> float:
    """Return minus twice the logarithm of the restricted likelihood."""
    whole = own + np.diag(np.repeat(np.asarray(spread) ** 2, 3))
    weight = np.linalg.inv(whole)
    pictures = int(group.max()) + 1
    total, right = np.zeros((pictures, 6, 6)), np.zeros((pictures, 6))
    np.add.at(total, group, weight)
    np.add.at(right, group, (weight @ estimates[..., None])[..., 0])
    mean = np.linalg.solve(total, right[..., None])[..., 0]
    apart = estimates - mean[group]
    square = np.einsum("vi,vij,vj->v", apart, weight, apart)
    # A view that lies far off counts like one at a bound: it is found and named elsewhere.
    bounded = np.where(square < _BOUND, square, 2 * np.sqrt(_BOUND * square) - _BOUND)
    return float(bounded.sum() + np.linalg.slogdet(whole)[1].sum() + np.linalg.slogdet(total)[1].sum())


_BOUND = 25.0
"""Square of a view's distance, in six dimensions, from which it counts less; exceeded by chance 3 times in 10 000."""
