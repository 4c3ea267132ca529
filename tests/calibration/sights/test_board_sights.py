"""How far readings of relative poses are from a pose, as shares of what counts as agreement."""

import numpy as np
import pytest

from marey.calibration.sights.board_sights import SAME_ANGLE, SAME_SHIFT, PoseReadings
from marey.geometry import rotations


def test_deviations_are_those_of_the_plain_formula(rng):
    turn, first, second = (rotations.exp(rng.normal(size=(6, 4, 3))), *(4 * rng.normal(size=(2, 6, 4, 3))))
    first[3, 2] = second[3, 2] = np.nan
    readings = PoseReadings(rotation=turn, first=first, second=second)
    rotation, shift = rotations.exp(rng.normal(size=(5, 3))), 4 * rng.normal(size=(5, 3))
    # The first pose is that of a reading.
    rotation[0], shift[0] = turn[2, 1], second[2, 1] - turn[2, 1] @ first[2, 1]
    found = readings.deviations(rotation, shift)
    assert found.shape == (5, 6, 4)
    for n, i, j in np.ndindex(found.shape):
        if (i, j) == (3, 2):
            assert found[n, i, j] == np.inf
            continue
        angle = np.linalg.norm(rotations.log(rotation[n] @ turn[i, j].T))
        apart = np.linalg.norm(rotation[n] @ first[i, j] + shift[n] - second[i, j])
        far = np.linalg.norm(second[i, j])
        expected = (angle / SAME_ANGLE) ** 2 + (apart / (SAME_SHIFT * far)) ** 2
        assert found[n, i, j] == pytest.approx(expected, rel=1e-7, abs=1e-9)
