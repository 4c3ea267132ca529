"""Low-rank tracks from the information of grey values about each position, in both image directions at once."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask

_TINY = 1e-9
"""Information added to keep singular matrices solvable [1/px2]; a numerical threshold."""
_TAIL = 4.0
"""Degrees of freedom of the t distribution of positions about the model; few of them make the fit robust to outliers.
Chosen by hand; results were not measured against other values."""
_UNWEIGHTED_ROUNDS = 3
"""Number of first rounds in which all positions have the same weight. Chosen by hand; results were not measured against
other values."""
LEAST_POINTS_SEEN = 3
"""Least number of points with information in a frame that is part of the model, as a translation and a rotation of the
image require."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PlaceEquations:
    """Information about the position of each point in each frame, independent of the other points."""

    information: Floats
    """(F, P, 2, 2) inverse covariance [1/px2]; zero where there is no information."""
    right: Floats
    """(F, P, 2) information times position [1/px]."""

    @property
    def known(self) -> Mask:
        """(F, P) mask of the positions with information."""
        return np.asarray(np.trace(self.information, axis1=2, axis2=3) > 0)

    def without(self, hidden: Mask) -> "PlaceEquations":
        """Return the equations without the positions in the mask (F, P)."""
        return PlaceEquations(
            information=np.where(hidden[..., None, None], 0, self.information),
            right=np.where(hidden[..., None], 0, self.right),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class LowRankTracks:
    """Tracks of low rank, W = Q B plus a translation ([Alexander2003] eq. (12))."""

    rows: Floats
    """(F, 2, 1 + r) translation [px] and weights Q; NaN in frames without enough information."""
    columns: Floats
    """(P, 1 + r) ones and the basis B, centred and with unit covariance over the points."""
    covariance: Floats
    """(F, 2 (1 + r), 2 (1 + r)) covariance of the rows, x before y."""
    spread: float
    """Standard deviation of a coordinate about the model, in addition to the uncertainty of the grey values [px]."""
    weight: Floats
    """(F, P) weight of each position; near zero for outliers."""

    @property
    def rank(self) -> int:
        """Rank r, beside the translation."""
        return int(self.columns.shape[1]) - 1

    def places(self) -> Floats:
        """Compute the tracks of the model (F, P, 2) [px]."""
        return np.swapaxes(self.rows @ self.columns.T, 1, 2)

    def place_covariance(self) -> Floats:
        """Compute the covariance (F, P, 2, 2) of a point about the model's tracks, given the other points [px2]."""
        count = self.columns.shape[1]
        blocks = self.covariance.reshape(-1, 2, count, 2, count)
        both = np.einsum("pa,fiajb,pb->fpij", self.columns, blocks, self.columns, optimize=True)
        return np.asarray(both + self.spread**2 * np.eye(2))


def low_rank_tracks(equations: PlaceEquations, tracks: Floats, rank: int, *, rounds: int = 25) -> LowRankTracks:
    """Solve for the tracks of all points in all frames together, at a given rank.

    Translation, weights and basis are solved in turn, each by linear least squares from the 2x2 structure matrices
    ([Irani1999], [Torresani2001]). Unlike there, departures from the low rank have a standard deviation, which is
    estimated, so that strong corners need not be of low rank exactly, and outliers have a reduced weight.

    Args:
        equations: Information about each position.
        tracks: (F, P, 2) initial positions, finite in each frame that has equations [px].
        rank: Rank beside the translation.
        rounds: Number of rounds.

    Returns:
        The model; NaN in frames with fewer than three points with information.
    """
    known = equations.known
    used = known.sum(axis=1) >= LEAST_POINTS_SEEN
    information, right, known = equations.information[used], equations.right[used], known[used]
    columns, start = _start(tracks[used], rank)
    spread, ridge = 1.0, np.zeros(rank + 1)
    weight = known.astype(float)
    middle, places = tracks[used].mean(axis=1), start
    for turn in range(rounds):
        weight = _weights(information, right, places, spread) * known if turn >= _UNWEIGHTED_ROUNDS else weight
        of_model, pulled = _marginalised(information * weight[..., None, None], right * weight[..., None], spread)
        rows, covariance = _solve_frames(of_model, pulled, columns, ridge, middle)
        columns, rows = _normalised(_solve_points(of_model, pulled, rows), rows)
        ridge = np.concatenate([[0], 1 / (np.mean(rows[..., 1:] ** 2, axis=(0, 1)) + 1e-6)])
        middle, places = rows[..., 0], np.swapaxes(rows @ columns.T, 1, 2)
        spread = _spread(information, right, places, weight, spread)
    of_model, pulled = _marginalised(information * weight[..., None, None], right * weight[..., None], spread)
    rows, covariance = _solve_frames(of_model, pulled, columns, ridge, middle)
    return _whole(used, rows, columns, covariance, spread, weight)


def _whole(
    used: Mask, rows: Floats, columns: Floats, covariance: Floats, spread: float, weight: Floats
) -> LowRankTracks:
    """Insert the used frames among all frames."""
    all_rows = np.full((len(used), *rows.shape[1:]), np.nan)
    all_covariance = np.full((len(used), *covariance.shape[1:]), np.nan)
    all_weight = np.zeros((len(used), weight.shape[1]))
    all_rows[used], all_covariance[used], all_weight[used] = rows, covariance, weight
    return LowRankTracks(rows=all_rows, columns=columns, covariance=all_covariance, spread=spread, weight=all_weight)


def _start(tracks: Floats, rank: int) -> tuple[Floats, Floats]:
    """Compute the columns (P, 1 + r) and positions (F, P, 2) of the nearest tracks of low rank."""
    centred = tracks - tracks.mean(axis=1, keepdims=True)
    stacked = np.swapaxes(centred, 1, 2).reshape(-1, tracks.shape[1])
    _, _, basis = np.linalg.svd(stacked, full_matrices=False)
    basis = basis[:rank].T
    near = np.swapaxes((stacked @ basis @ basis.T).reshape(len(tracks), 2, -1), 1, 2)
    columns = np.concatenate([np.ones((len(basis), 1)), basis * np.sqrt(len(basis))], axis=1)
    return columns, near + tracks.mean(axis=1, keepdims=True)


def _marginalised(information: Floats, right: Floats, spread: float) -> tuple[Floats, Floats]:
    """Convert information and right-hand side about a point's position into those about the model's position."""
    mixed = inverse_of_symmetric(np.eye(2) + spread**2 * information)
    return mixed @ information, times(mixed, right)


def times(matrices: Floats, vectors: Floats) -> Floats:
    """Multiply matrices (..., 2, 2) and vectors (..., 2)."""
    x, y = vectors[..., 0], vectors[..., 1]
    first, second = matrices[..., 0, 0] * x + matrices[..., 0, 1] * y, matrices[..., 1, 0] * x + matrices[..., 1, 1] * y
    return np.stack([first, second], axis=-1)


def inverse_of_symmetric(matrices: Floats) -> Floats:
    """Invert symmetric matrices (..., 2, 2) in closed form, faster than `numpy.linalg.inv` for many small ones."""
    xx, xy, yy = matrices[..., 0, 0], matrices[..., 0, 1], matrices[..., 1, 1]
    determinant = xx * yy - xy * xy
    rows = np.stack([yy, -xy, -xy, xx], axis=-1) / determinant[..., None]
    return rows.reshape(matrices.shape)


def _weights(information: Floats, right: Floats, places: Floats, spread: float) -> Floats:
    """Compute the weight of each position (F, P) from its distance from the model, relative to its covariance."""
    pull = right - times(information, places)
    firm = information + _TINY * np.eye(2)
    away = times(inverse_of_symmetric(firm), pull)
    pulled = times(inverse_of_symmetric(np.eye(2) + spread**2 * firm), pull)
    square = np.einsum("fpi,fpi->fp", away, pulled)
    return np.asarray((_TAIL + 2) / (_TAIL + np.maximum(square, 0)))


def _solve_frames(
    information: Floats, right: Floats, columns: Floats, ridge: Floats, middle: Floats
) -> tuple[Floats, Floats]:
    """Solve for the rows (F, 2, k) of each frame, given the columns; also their covariance (F, 2k, 2k)."""
    frames, count = len(information), columns.shape[1]
    pairs = (columns[:, :, None] * columns[:, None]).reshape(len(columns), -1)
    xx, xy, yy = ((information[..., i, j] @ pairs).reshape(frames, count, count) for i, j in ((0, 0), (0, 1), (1, 1)))
    normal = np.concatenate([np.concatenate([xx, xy], axis=2), np.concatenate([xy, yy], axis=2)], axis=1)
    # A weak pull towards previous values, which matters only for translations without information.
    held = np.tile(ridge, 2) + _TINY
    normal[:, range(2 * count), range(2 * count)] += held
    side = np.concatenate([right[..., 0] @ columns, right[..., 1] @ columns], axis=1)
    side[:, [0, count]] += _TINY * middle
    covariance = np.linalg.inv(normal)
    return np.einsum("fab,fb->fa", covariance, side).reshape(frames, 2, count), covariance


def _solve_points(information: Floats, right: Floats, rows: Floats) -> Floats:
    """Solve for the basis (P, r), given the frames."""
    weights, middle = rows[..., 1:], rows[..., 0]
    rank = weights.shape[2]
    left = right - times(information, middle[:, None])
    normal = np.zeros((information.shape[1], rank * rank))
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        pairs = (weights[:, i, :, None] * weights[:, j, None]).reshape(len(rows), -1)
        normal += information[..., i, j].T @ pairs
    square = normal.reshape(-1, rank, rank) + np.eye(rank)
    side = np.einsum("fpi,fia->pa", left, weights, optimize=True)
    return np.linalg.solve(square, side[..., None])[..., 0]


def _normalised(basis: Floats, rows: Floats) -> tuple[Floats, Floats]:
    """Centre the basis and scale it to unit covariance, changing the rows so that the tracks stay the same."""
    middle = basis.mean(axis=0)
    scale, turn = np.linalg.eigh(np.cov(basis.T, bias=True).reshape(len(middle), -1))
    scale = np.sqrt(np.maximum(scale, 1e-12 * scale[-1] + 1e-300))
    weights = rows[..., 1:]
    translation = rows[..., :1] + (weights @ middle)[..., None]
    columns = np.concatenate([np.ones((len(basis), 1)), (basis - middle) @ turn / scale], axis=1)
    return columns, np.concatenate([translation, weights @ turn * scale], axis=2)


def _spread(information: Floats, right: Floats, places: Floats, weight: Floats, spread: float) -> float:
    """Update the standard deviation of a coordinate about the model by one step of expectation maximisation."""
    variance = inverse_of_symmetric(information + np.eye(2) / spread**2)
    moved = times(variance, right - times(information, places))
    square = np.sum(moved**2, axis=2) + np.trace(variance, axis1=2, axis2=3)
    return float(np.sqrt(max(np.sum(weight * square) / (2 * np.sum(weight)), 1e-6)))
