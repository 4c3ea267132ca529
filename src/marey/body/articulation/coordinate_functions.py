"""Functions of one coordinate in joint models, as piecewise polynomials."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields
from marey.errors import MareyError


@dataclass(frozen=True, eq=False, kw_only=True)
class PiecewisePolynomial:
    """A piecewise polynomial on the real line; the first piece extends to minus infinity, the last to infinity."""

    starts: Floats
    """(P,) start of each piece, ascending; that of the first piece is only the origin of its powers."""
    coefficients: Floats
    """(P, K) coefficients of the powers 0, 1, ... of the distance from the piece's start."""

    def __post_init__(self) -> None:
        freeze_fields(self, "starts", "coefficients")
        if self.coefficients.ndim != 2 or self.starts.shape != self.coefficients.shape[:1] or not len(self.starts):
            raise MareyError(f"{len(self.starts)} pieces do not match coefficients of shape {self.coefficients.shape}.")
        if not (np.isfinite(self.starts).all() and np.isfinite(self.coefficients).all()):
            raise MareyError("The coefficients of a function must be finite.")

    def at(self, x: Floats | float) -> tuple[Floats, Floats]:
        """Return value and slope at x (...)."""
        x = np.asarray(x, float)
        piece = np.clip(np.searchsorted(self.starts, x, "right") - 1, 0, None)
        distance = x - self.starts[piece]
        value, slope = np.zeros_like(x), np.zeros_like(x)
        for coefficient in np.moveaxis(self.coefficients[piece], -1, 0)[::-1]:
            slope = slope * distance + value
            value = value * distance + coefficient
        return value, slope

    @property
    def fixed(self) -> bool:
        """Whether the function is constant."""
        return not self.coefficients[:, 1:].any() and bool((self.coefficients[:, 0] == self.coefficients[0, 0]).all())


class PackedFunctions(NamedTuple):
    """Several functions as plain arrays, for the kernels."""

    first: Integers
    """(G + 1,) first piece of each function."""
    starts: Floats
    """(P,)."""
    coefficients: Floats
    """(P, K)."""


def pack(functions: list[PiecewisePolynomial]) -> PackedFunctions:
    """Concatenate functions into plain arrays."""
    powers = max((f.coefficients.shape[1] for f in functions), default=1)
    first = np.concatenate([[0], np.cumsum([len(f.starts) for f in functions])]).astype(np.int64)
    coefficients = np.zeros((int(first[-1]), powers))
    for begin, f in zip(first, functions, strict=False):
        coefficients[begin : begin + len(f.starts), : f.coefficients.shape[1]] = f.coefficients
    starts = np.concatenate([f.starts for f in functions]) if functions else np.zeros(0)
    return PackedFunctions(first, np.ascontiguousarray(starts), coefficients)


def constant(value: float) -> PiecewisePolynomial:
    """Return a constant function."""
    return PiecewisePolynomial(starts=np.zeros(1), coefficients=np.array([[value]]))


def polynomial(highest_first: Floats) -> PiecewisePolynomial:
    """Return a polynomial from its coefficients, that of the highest power first.

    Raises:
        MareyError: There is no coefficient.
    """
    coefficients = np.atleast_1d(np.asarray(highest_first, float))[::-1]
    if not len(coefficients):
        raise MareyError("A polynomial needs at least one coefficient.")
    return PiecewisePolynomial(starts=np.zeros(1), coefficients=coefficients[None])


def linear(slope: float, intercept: float = 0.0) -> PiecewisePolynomial:
    """Return a linear function."""
    return polynomial(np.array([slope, intercept]))


def scaled(function: PiecewisePolynomial, factor: float) -> PiecewisePolynomial:
    """Return a function multiplied by a factor."""
    return PiecewisePolynomial(starts=function.starts, coefficients=function.coefficients * factor)


def piecewise_linear(x: Floats, y: Floats) -> PiecewisePolynomial:
    """Interpolate points linearly; beyond the ends the last lines are continued.

    Args:
        x: (n,) ascending.
        y: (n,).

    Raises:
        MareyError: There are fewer than two points, or x does not ascend.
    """
    x, y = _points(x, y)
    return PiecewisePolynomial(starts=x[:-1], coefficients=np.stack([y[:-1], np.diff(y) / np.diff(x)], 1))


def simm_spline(x: Floats, y: Floats) -> PiecewisePolynomial:
    """Interpolate points by SIMM's cubic spline, as OpenSim's SimmSpline does.

    Its third derivative in the first and in the last piece is that of the cubic through the four points there
    ([Forsythe1977] chapter 4); beyond the ends it is continued linearly. Two points give a line, three a parabola.

    Args:
        x: (n,) ascending.
        y: (n,).

    Raises:
        MareyError: There are fewer than two points, or x does not ascend.
    """
    x, y = _points(x, y)
    count = len(x)
    if count == 2:
        return piecewise_linear(x, y)
    width, slope = np.diff(x), np.diff(y) / np.diff(x)
    system, right = np.zeros((count, count)), np.zeros(count)
    for i in range(1, count - 1):
        system[i, i - 1 : i + 2] = width[i - 1], 2 * (width[i - 1] + width[i]), width[i]
        right[i] = 6 * (slope[i] - slope[i - 1])
    for row, end in ((0, slice(0, 4)), (-1, slice(-4, None))):
        piece = (0, 1) if row == 0 else (-2, -1)
        system[row, piece[0]], system[row, piece[1]] = -1.0, 1.0
        right[row] = width[row] * (6 * _third_difference(x[end], y[end]) if count > 3 else 0.0)
    second = np.linalg.solve(system, right)
    inner = np.stack(
        [y[:-1], slope - width * (2 * second[:-1] + second[1:]) / 6, second[:-1] / 2, np.diff(second) / (6 * width)], 1
    )
    end_slope = slope[-1] + width[-1] * (second[-2] + 2 * second[-1]) / 6
    outer = np.array([[y[0], inner[0, 1], 0, 0], [y[-1], end_slope, 0, 0]])
    # The line before the first point has that point as its origin: its start is the number just below it.
    return PiecewisePolynomial(
        starts=np.concatenate([[np.nextafter(x[0], -np.inf)], x]),
        coefficients=np.concatenate([outer[:1], inner, outer[1:]]),
    )


def _third_difference(x: Floats, y: Floats) -> float:
    """Return the third divided difference of four points."""
    for order in range(1, 4):
        y = np.diff(y) / (x[order:] - x[:-order])
    return float(y[0])


def _points(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    x, y = np.asarray(x, float).ravel(), np.asarray(y, float).ravel()
    if len(x) != len(y) or len(x) < 2 or not (np.diff(x) > 0).all():
        raise MareyError(
            f"An interpolating function needs at least two points with ascending x; it has {len(x)} x and {len(y)} y."
        )
    return x, y
