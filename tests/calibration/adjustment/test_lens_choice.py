"""The smallest model of each lens that describes its corners, and what missing coefficients add to the covariance."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from tests.made_boards import BOARD, MadeSession, made_rig, made_session

from marey.calibration.adjustment.lens_choice import DISTORTION_NAMES, LENS_MODELS
from marey.calibration.adjustment.solve import SolvedSession, solve_session
from marey.calibration.adjustment.state import CAMERA, LENS
from marey.cameras.rig import Rig

LENSES = ((0.0, 0.0, 0.0, 0.0), (-0.15, 0.0, 0.0, 0.0), (-0.2, 0.1, 2e-3, -2e-3))
"""True coefficients k1, k2, p1, p2: none, one, and four, each many standard deviations from zero or exactly zero."""


@pytest.fixture(scope="module")
def session() -> MadeSession:
    rig = made_rig(3, np.random.default_rng(8))
    lenses = [replace(camera, distortion=np.array(own)) for camera, own in zip(rig, LENSES, strict=True)]
    return made_session(pictures=60, seed=8, rig=Rig(tuple(lenses)), floor=0)


@pytest.fixture(scope="module")
def solved(session: MadeSession) -> SolvedSession:
    return solve_session(session.corners, BOARD)


def test_a_lens_gets_the_coefficients_that_it_has(solved: SolvedSession):
    for choice, true in zip(solved.choices, LENSES, strict=True):
        assert choice is not None
        needed = {name for name, value in zip(DISTORTION_NAMES, true, strict=False) if value}
        assert needed <= set(choice.coefficients)
        best = min(choice.evidence, key=lambda each: each.cost)
        assert best.coefficients == choice.coefficients
        # What the model lacks is noise: exceeded by chance once in a thousand sessions.
        missing = len(DISTORTION_NAMES) - len(best.coefficients)
        assert best.chi_square <= chi2.ppf(0.999, missing)
    assert len(solved.choices[0].coefficients) < len(solved.choices[2].coefficients)


def test_a_model_never_describes_the_corners_worse_than_one_that_it_contains(solved: SolvedSession):
    for choice in solved.choices:
        assert [each.coefficients for each in choice.evidence] == list(LENS_MODELS)
        assert sum(each.probability for each in choice.evidence) == pytest.approx(1.0)
        for large in choice.evidence:
            for small in choice.evidence:
                if set(small.coefficients) <= set(large.coefficients):
                    assert large.chi_square <= small.chi_square + 1e-6


def test_missing_coefficients_are_zero_with_a_standard_deviation_that_covers_the_truth(solved: SolvedSession):
    sd = np.sqrt(np.diag(solved.covariance))[: CAMERA * 3].reshape(3, CAMERA)[:, :LENS]
    missing = ~solved.lens
    assert missing.any()
    assert np.all(solved.state.lens[missing] == 0)
    true = np.array([[*own, 0.0] for own in LENSES])
    off = np.abs(solved.state.lens[:, 4:] - true)
    # The largest of 15 normal deviations exceeds 4.2 once in three thousand sessions.
    assert np.all(off < 4.2 * sd[:, 4:])
    assert np.linalg.eigvalsh(solved.covariance).min() > -1e-12


@pytest.mark.slow
def test_a_given_model_is_used_and_its_missing_coefficients_are_certain(session: MadeSession):
    found = solve_session(session.corners, BOARD, fixed=[("k1", "k2"), None, ("k1", "k2", "p1", "p2")])
    assert found.lens[0, 4:].tolist() == [True, True, False, False, False]
    assert found.lens[2, 4:].tolist() == [True, True, True, True, False]
    assert [choice.fixed for choice in found.choices] == [True, False, True]
    variance = np.diag(found.covariance)[:LENS]
    assert np.all(variance[6:] == 0)
    assert np.all(variance[:6] > 0)
