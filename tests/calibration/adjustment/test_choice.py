"""The pictures that add most to what is known of the cameras."""

import numpy as np
import pytest
from tests.made_boards import BOARD, made_session

from marey.calibration.adjustment.choice import informative_pictures
from marey.calibration.adjustment.covariance import picture_shares
from marey.calibration.adjustment.solve import SolvedSession, solve_session


@pytest.fixture(scope="module")
def solved() -> SolvedSession:
    return solve_session(made_session(cameras=3, pictures=60, seed=2, floor=0).corners, BOARD, model=False)


Shares = dict[int, tuple[np.ndarray, np.ndarray]]


@pytest.fixture(scope="module")
def shares(solved: SolvedSession) -> Shares:
    """Indices of unknowns and normal matrix of each picture."""
    return {pose: (index, share) for pose, index, _, share in picture_shares(solved.adjusted)}


def information(solved: SolvedSession, shares: Shares, chosen: np.ndarray) -> float:
    """The logarithm of the determinant of the chosen pictures' information, with a little of the whole."""
    free = solved.adjusted.problem.free
    whole = solved.adjusted.blocks.reduced()[0][np.ix_(free, free)]
    own = np.zeros_like(whole)
    for pose, (index, share) in shares.items():
        if chosen[pose]:
            own[np.ix_(index, index)] += share
    return float(np.linalg.slogdet(own + 1e-6 * whole)[1])


def test_chosen_pictures_add_more_than_any_even_or_random_choice(solved: SolvedSession, shares: Shares):
    chosen = informative_pictures(solved, 15)
    assert chosen.sum() == 15
    best = information(solved, shares, chosen)
    rng = np.random.default_rng(0)
    used = np.unique(solved.corners.picture)
    for _ in range(40):
        other = np.zeros(len(chosen), bool)
        other[rng.choice(used, 15, replace=False)] = True
        assert information(solved, shares, other) < best


def test_bounds_of_earlier_steps_do_not_change_the_choice(solved: SolvedSession, shares: Shares):
    used, picked = np.unique(solved.corners.picture), np.zeros(len(solved.corners.pictures), bool)
    for _ in range(4):
        gains = {}
        for picture in used[~picked[used]]:
            trial = picked.copy()
            trial[picture] = True
            gains[int(picture)] = information(solved, shares, trial)
        picked[max(gains, key=gains.__getitem__)] = True
    np.testing.assert_array_equal(informative_pictures(solved, 4), picked)


def test_all_pictures_are_chosen_of_a_short_session(solved: SolvedSession):
    used = np.unique(solved.corners.picture)
    np.testing.assert_array_equal(np.flatnonzero(informative_pictures(solved, 1000)), used)
