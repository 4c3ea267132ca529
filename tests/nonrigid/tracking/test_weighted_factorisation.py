import numpy as np

from marey.nonrigid.tracking.weighted_factorisation import PlaceEquations, low_rank_tracks

FRAMES, POINTS, RANK, SD = 40, 30, 4, 0.2


def made_tracks(rng: np.random.Generator) -> np.ndarray:
    basis = rng.standard_normal((POINTS, RANK))
    weights = np.cumsum(rng.standard_normal((FRAMES, 2, RANK)), axis=0)
    middle = np.cumsum(rng.standard_normal((FRAMES, 1, 2)), axis=0)
    return middle + np.swapaxes(weights @ basis.T, 1, 2)


def made(rng: np.random.Generator, edges: int = 8) -> tuple[PlaceEquations, np.ndarray]:
    """Noisy places; the last points know only one direction."""
    truth = made_tracks(rng)
    information = np.tile(np.eye(2) / SD**2, (FRAMES, POINTS, 1, 1))
    angle = rng.uniform(0, np.pi, (FRAMES, edges))
    across = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    information[:, -edges:] = across[..., :, None] * across[..., None, :] / SD**2
    noisy = truth + SD * rng.standard_normal(truth.shape)
    return PlaceEquations(information=information, right=np.einsum("fpij,fpj->fpi", information, noisy)), truth


def test_positions_known_in_one_direction_are_constrained_by_others():
    rng = np.random.default_rng(0)
    equations, truth = made(rng)
    model = low_rank_tracks(equations, truth + 0.5 * rng.standard_normal(truth.shape), RANK)
    # Each frame has 10 unknowns from 52 numbers, each edge point 4 from 40: less than the noise of one number is left.
    assert np.sqrt(np.mean((model.places() - truth) ** 2)) < SD


def test_outliers_have_a_reduced_weight():
    rng = np.random.default_rng(1)
    equations, truth = made(rng)
    equations.right[3, 5] += 20 / SD**2
    model = low_rank_tracks(equations, truth + 0.5 * rng.standard_normal(truth.shape), RANK)
    assert model.weight[3, 5] < 0.1
    assert np.median(model.weight) > 0.8
    assert np.linalg.norm(model.places()[3, 5] - truth[3, 5]) < 5 * SD


def test_standard_deviations_of_hidden_positions_are_valid():
    rng = np.random.default_rng(2)
    equations, truth = made(rng)
    hidden = rng.random((FRAMES, POINTS)) < 0.2
    model = low_rank_tracks(equations.without(hidden), truth + 0.5 * rng.standard_normal(truth.shape), RANK)
    away = (model.places() - truth)[hidden]
    sd = np.sqrt(np.diagonal(model.place_covariance(), axis1=2, axis2=3))[hidden]
    # The uncertainty of the basis is not included; with 40 frames it is small.
    assert 0.85 < np.mean(np.abs(away) < 1.96 * sd) <= 1


def test_a_frame_without_points_is_unknown():
    rng = np.random.default_rng(3)
    equations, truth = made(rng)
    hidden = np.zeros((FRAMES, POINTS), bool)
    hidden[7] = True
    model = low_rank_tracks(equations.without(hidden), truth, RANK)
    assert np.isnan(model.places()[7]).all()
    assert np.isfinite(np.delete(model.places(), 7, axis=0)).all()
