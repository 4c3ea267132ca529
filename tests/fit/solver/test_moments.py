"""The normal equations from moments are those of the dense derivative."""

import numpy as np
import pytest
from tests import people

from marey.body.articulation.pose import PosedBody
from marey.fit.solver.moments import gather_moments
from marey.fit.solver.normal_equations import normal_equations
from marey.observations.silhouette import SilhouettePlanes, SilhouetteRays


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def observations(rng, body, count):
    where = people.any_points(rng, body, count)
    scale = rng.uniform(100, 300, count)
    planes = SilhouettePlanes(
        where=where, normals=unit(rng.normal(size=(count, 3))), offsets=rng.normal(size=count),
        pixels_per_metre=scale, sigma_px=1.3,
    )  # fmt: skip
    rays = SilhouetteRays(
        where=people.any_points(rng, body, count), directions=unit(rng.normal(size=(count, 3))),
        moments=rng.normal(size=(count, 3)), pixels_per_metre=scale, sigma_px=0.7,
    )  # fmt: skip
    return [planes, rays]


@pytest.mark.parametrize("spread", [0.0, 0.5])
def test_moments_give_the_dense_normal_equations_also_in_another_pose(rng, spread):
    body = people.stick_person(rng)
    built = PosedBody(body, people.any_pose(rng, body))
    kinds = observations(rng, body, 80)
    weights = [rng.uniform(0, 1, 80), rng.uniform(0, 1, 80)]
    moments = gather_moments(built, kinds, weights)
    posed = PosedBody(body, people.any_pose(rng, body, spread=spread))
    hessian, gradient, cost = normal_equations(posed, moments)
    whitened = [kind.whiten(posed) for kind in kinds]
    per_row = [np.repeat(w, len(k.residual) // len(w)) for w, k in zip(weights, whitened, strict=True)]
    dense = sum(k.jacobian.T @ (w[:, None] * k.jacobian) for w, k in zip(per_row, whitened, strict=True))
    slope = sum(k.jacobian.T @ (w * k.residual) for w, k in zip(per_row, whitened, strict=True))
    np.testing.assert_allclose(hessian, dense, atol=1e-9 * np.abs(dense).max())
    np.testing.assert_allclose(gradient, slope, atol=1e-9 * np.abs(slope).max())
    expected = sum(w @ k.residual**2 for w, k in zip(per_row, whitened, strict=True))
    np.testing.assert_allclose(cost, expected, rtol=1e-9)
