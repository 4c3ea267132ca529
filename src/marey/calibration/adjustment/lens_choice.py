"""Choice of the distortion coefficients of each lens: the smallest model that describes its corners.

All models are compared by the largest one, which is adjusted once: what a model lacks costs the chi-square of the
missing coefficients, and the others change by their covariance with these. A model is preferred for few coefficients as
by [Hannan1979], with the number of pictures that determine the lens instead of that of the corners, since the errors of
the corners of one picture are not independent.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.calibration.adjustment.adjust import Adjusted
from marey.calibration.adjustment.covariance import free_covariance, picture_shares
from marey.calibration.adjustment.state import CAMERA, LENS_NAMES, shape_unknowns

DISTORTION_NAMES = LENS_NAMES[4:]
"""Distortion coefficients in the order of their columns: k1, k2, p1, p2, k3."""
LENS_MODELS = tuple(
    tuple(name for name in DISTORTION_NAMES if name in ("k1", "k2", "k3")[:radial] + tangential)
    for radial in range(4)
    for tangential in ((), ("p1", "p2"))
)
"""Coefficients of the models that are compared: none to three radial ones, with or without the tangential pair."""
_DISTORTION = np.arange(len(LENS_NAMES) - len(DISTORTION_NAMES), len(LENS_NAMES))
"""Columns of the distortion coefficients among the parameters of a lens."""
_LEAST_PENALTY = 2.0
"""Least chi-square that a coefficient must explain, that of Akaike's criterion, for a lens with few pictures."""
_THIRD_PENALTY = 9.0
"""Chi-square that k3 must explain: three standard deviations, since it bends the uncovered parts of an image most.

On the rendered session, a k3 of two cameras with less evidence displaced points in an uncovered corner by up to
6 px, where the lens without it was right to 0.05 px."""

FixedModel = tuple[str, ...] | None
"""Coefficients of a lens that were given; None where the corners decide."""


@dataclass(frozen=True, kw_only=True)
class LensEvidence:
    """How well one model of a lens describes its corners."""

    coefficients: tuple[str, ...]
    """Distortion coefficients of the model."""
    chi_square: float
    """Chi-square of the coefficients that it lacks: by how much the largest model fits better."""
    cost: float
    """The same with the price of its own coefficients; the model of the least cost is chosen."""
    probability: float
    """Weight of the model in the uncertainty of the lens: exp(-cost / 2), with a sum of one."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LensChoice:
    """The model of one lens, and how it compares with the others."""

    coefficients: tuple[str, ...]
    """Distortion coefficients that are estimated."""
    fixed: bool
    """Whether they were given."""
    pictures: float
    """Number of pictures that would determine the coefficients as well if all determined them equally well."""
    evidence: tuple[LensEvidence, ...]
    """All models in the order of `LENS_MODELS`."""
    moments: Floats
    """(5, 5) expected products of the coefficients, over all models with their probabilities."""

    def __post_init__(self) -> None:
        freeze_fields(self, "moments")

    @property
    def lens(self) -> Mask:
        """(9,) parameters of the lens that are estimated."""
        return np.array([name not in DISTORTION_NAMES or name in self.coefficients for name in LENS_NAMES])

    @property
    def omitted(self) -> Floats:
        """(9, 9) expected products of the coefficients that are not estimated; zero if the model was given."""
        found = np.zeros((len(LENS_NAMES), len(LENS_NAMES)))
        if not self.fixed:
            found[np.ix_(_DISTORTION, _DISTORTION)] = self.moments
            found[self.lens], found[:, self.lens] = 0.0, 0.0
        return found

    @property
    def preferred(self) -> list[tuple[str, ...]]:
        """The models from the least to the greatest cost."""
        return [each.coefficients for each in sorted(self.evidence, key=lambda each: each.cost)]


def choose_lenses(largest: Adjusted, fixed: Sequence[FixedModel], *, shape: bool) -> tuple[LensChoice | None, ...]:
    """Choose the model of each lens.

    Args:
        largest: The solution with all coefficients of all lenses.
        fixed: Coefficients of each camera that were given; may be empty.
        shape: Whether the board's shape is estimated; if not, its values in the solution are taken back to zero.

    Returns:
        The choice of each camera; None for one whose lens was not estimated.
    """
    inverse, free = free_covariance(largest), largest.problem.free
    position = np.cumsum(free) - 1
    shares = list(picture_shares(largest))
    found: list[LensChoice | None] = []
    for camera, lens in enumerate(largest.state.lens):
        index = CAMERA * camera + _DISTORTION
        if not free[index].all():
            found.append(None)
            continue
        own = position[index]
        pictures, inflation = _picture_statistics(shares, inverse, own)
        values = np.concatenate([lens[_DISTORTION], largest.state.shape])
        shaped = shape_unknowns(largest.state.cameras)
        whole = np.concatenate([own, position[shaped]]) if free[shaped].all() else own
        gone = (np.arange(len(whole)) >= len(own)) & (not shape)
        mean, spread, _ = _without(values[: len(whole)], inverse[np.ix_(whole, whole)], gone)
        covariance = inflation * spread[: len(own), : len(own)]
        found.append(_choice(mean[: len(own)], covariance, pictures, fixed[camera] if fixed else None))
    return tuple(found)


def _choice(values: Floats, covariance: Floats, pictures: float, fixed: FixedModel) -> LensChoice:
    """Compare all models of one lens by values (5,) and covariance (5, 5) of its coefficients."""
    price = max(_LEAST_PENALTY, 2.0 * float(np.log(np.log(max(pictures, math.e)))))
    chi_square, cost, second = np.zeros(len(LENS_MODELS)), np.zeros(len(LENS_MODELS)), []
    for number, model in enumerate(LENS_MODELS):
        gone = np.array([name not in model for name in DISTORTION_NAMES])
        mean, spread, chi_square[number] = _without(values, covariance, gone)
        second.append(spread + np.outer(mean, mean))
        own = max(price, _THIRD_PENALTY) if "k3" in model else 0.0
        cost[number] = chi_square[number] + price * len([name for name in model if name != "k3"]) + own
    weight = np.exp(-0.5 * (cost - cost.min()))
    weight /= weight.sum()
    evidence = tuple(
        LensEvidence(
            coefficients=model, chi_square=float(chi_square[k]), cost=float(cost[k]), probability=float(weight[k])
        )
        for k, model in enumerate(LENS_MODELS)
    )  # fmt: skip
    return LensChoice(
        coefficients=LENS_MODELS[int(np.argmin(cost))] if fixed is None else fixed, fixed=fixed is not None,
        pictures=pictures, evidence=evidence, moments=np.einsum("m,mij->ij", weight, np.stack(second)),
    )  # fmt: skip


def _without(values: Floats, covariance: Floats, gone: Mask) -> tuple[Floats, Floats, float]:
    """Return values and covariance if some of the unknowns are zero, and the chi-square of these."""
    if not gone.any():
        return values, covariance, 0.0
    gain = np.linalg.solve(covariance[np.ix_(gone, gone)], covariance[gone]).T
    chi_square = float(values[gone] @ np.linalg.solve(covariance[np.ix_(gone, gone)], values[gone]))
    return values - gain @ values[gone], covariance - gain @ covariance[gone], chi_square


def _picture_statistics(
    shares: Sequence[tuple[int, Integers, Floats, Floats]], inverse: Floats, own: Integers
) -> tuple[float, float]:
    """Return how many pictures determine some unknowns, and the factor of their variances for errors that are shared.

    The contribution of a picture to the unknowns is compared with that expected from independent corners, as in
    `picture_inflation` for all unknowns together.
    """
    metric = np.linalg.inv(inverse[np.ix_(own, own)])
    observed, expected = np.zeros(len(shares)), np.zeros(len(shares))
    for number, (_, index, gradient, share) in enumerate(shares):
        across = inverse[np.ix_(own, index)]
        step, part = across @ gradient, across @ share
        observed[number] = step @ metric @ step
        spread = part @ across.T - part @ inverse[np.ix_(index, index)] @ part.T
        expected[number] = np.sum(metric * spread)
    total = float(expected.sum())
    return total**2 / float(np.sum(expected**2)), max(1.0, float(observed.sum()) / total)
