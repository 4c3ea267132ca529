"""The number of basis shapes of synthetic points is found."""

import numpy as np
import pytest
from tests.nonrigid.made_shapes import without_motion

from marey.errors import MareyError
from marey.geometry import rotations
from marey.nonrigid.in_space.measured_places import PointsInSpace
from marey.nonrigid.in_space.rank import RankChoiceSettings, choose_rank, significant_singular_values


@pytest.mark.slow
@pytest.mark.parametrize("modes", [0, 2])
def test_held_out_points_determine_the_rank(rng, modes):
    frames, points = 60, 12
    mean = rng.normal(size=(points, 3))
    mean -= mean.mean(0)
    displacements = without_motion(rng.normal(size=(modes, points, 3)), mean)
    shape = mean + np.einsum("fm,mpi->fpi", 0.15 * rng.normal(size=(frames, modes)), displacements)
    shape = np.broadcast_to(shape, (frames, points, 3))
    turned = np.einsum("fij,fpj->fpi", rotations.exp(rng.normal(size=(frames, 3))), shape)
    measured = PointsInSpace(turned + 0.02 * rng.normal(size=turned.shape))
    choice = choose_rank(measured, settings=RankChoiceSettings(most_shapes=6))
    assert choice.rank in (modes + 1, modes + 2)
    assert choice.held_out_rms[choice.rank - 1] < 0.06
    assert len(choice.ranks) == len(choice.held_out_rms) == len(choice.held_out_sd) >= 5


def test_too_few_points_are_an_error(rng):
    with pytest.raises(MareyError):
        choose_rank(PointsInSpace(rng.normal(size=(10, 2, 3))))


def test_singular_values_above_noise_are_counted(rng):
    signal = rng.normal(size=(200, 4)) @ rng.normal(size=(4, 50))
    values = np.linalg.svd(signal + 0.3 * rng.normal(size=signal.shape), compute_uv=False)
    assert significant_singular_values(values, signal.shape) == 4
