"""Sessions from made corners: the truth within its covariance, and what is wrong left out."""

from dataclasses import replace

import numpy as np
import pytest
from tests.made_boards import BOARD, MadeSession, made_session

from marey.calibration.adjustment.covariance import common_covariance
from marey.calibration.adjustment.displacement import estimate_displacement
from marey.calibration.adjustment.solve import (
    SolvedSession,
    connected_again,
    recorded_together,
    refined_session,
    solve_session,
)
from marey.calibration.adjustment.state import CAMERA, LENS
from marey.calibration.boards.corners import CornerSet
from marey.calibration.boards.still import join_still
from marey.calibration.quality.world import centre_slope, centres, find_floor, in_floor_world
from marey.errors import SettingProblem


def true_lenses(session: MadeSession) -> np.ndarray:
    return np.array(
        [[c.matrix[0, 0], c.matrix[1, 1], c.matrix[0, 2], c.matrix[1, 2], *c.distortion, 0.0] for c in session.rig]
    )


def solved_on_floor(session: MadeSession) -> SolvedSession:
    still = join_still(session.corners)
    solved = solve_session(still.corners, session.board)
    floor = find_floor(solved, still)
    assert floor == len(session.world_from_board) - 12
    return in_floor_world(solved, floor)


@pytest.fixture(scope="module")
def session() -> MadeSession:
    return made_session(cameras=4, pictures=110, seed=4)


@pytest.fixture(scope="module")
def solved(session: MadeSession) -> SolvedSession:
    return solved_on_floor(session)


def test_lenses_and_poses_are_the_true_ones_within_their_covariance(session: MadeSession, solved: SolvedSession):
    sd = np.sqrt(np.diag(solved.covariance))[: CAMERA * 4].reshape(4, CAMERA)
    lens = (solved.state.lens - true_lenses(session))[:, :8] / sd[:, :8]
    assert np.mean(lens**2) < 2.5
    assert np.abs(lens).max() < 4.5
    for camera, shift in enumerate(centres(solved.state) - session.rig.centres):
        own = slice(CAMERA * camera + LENS, CAMERA * (camera + 1))
        slope = centre_slope(solved.state, camera)
        spread = slope @ solved.covariance[own, own] @ slope.T
        # Chi-square with three degrees of freedom exceeds 21 once in ten thousand times.
        assert shift @ np.linalg.solve(spread, shift) < 21.1


def test_the_noise_is_estimated_and_nothing_left_out(solved: SolvedSession):
    assert solved.adjusted.unit == pytest.approx(1.0, abs=0.05)
    assert solved.adjusted.spread == (0.0, 0.0)
    assert solved.left_out == ()
    assert not solved.shape
    assert not solved.lens[:, 8].any()


def test_exact_corners_give_the_exact_cameras():
    session = made_session(cameras=3, pictures=60, seed=2, noise=0.0)
    still = join_still(session.corners)
    found = solve_session(still.corners, BOARD, model=False)
    # The priors of the lens pull by less than a hundredth of a pixel against corners of 0.001 px.
    np.testing.assert_allclose(found.state.lens[:, :4], true_lenses(session)[:, :4], atol=0.02)


@pytest.mark.slow
def test_start_from_wrong_focal_lengths(session: MadeSession, solved: SolvedSession):
    lenses = true_lenses(session)
    lenses[:, :2] *= 1.03
    lenses[:, 4:] = 0.0
    found = solve_session(join_still(session.corners).corners, BOARD, lenses=lenses, model=False)
    np.testing.assert_allclose(found.state.lens, solved.state.lens, atol=0.15)


@pytest.mark.slow
def test_a_view_that_contradicts_the_others_is_left_out_by_name(session: MadeSession):
    corners = session.corners
    busy = np.flatnonzero((np.bincount(corners.view_picture)[corners.view_picture] > 2) & (corners.view_counts > 30))
    rows = corners.view_rows(int(busy[0]))
    pixels = np.array(corners.pixels)
    pixels[rows] += [25.0, -10.0]
    found = solve_session(replace(corners, pixels=pixels), BOARD, model=False)
    wrong = {(each.picture, each.camera) for each in found.left_out}
    assert wrong == {(int(corners.view_picture[busy[0]]), int(corners.view_camera[busy[0]]))}


@pytest.fixture(scope="module")
def weakly_linked(session: MadeSession) -> tuple[CornerSet, np.ndarray]:
    """The session with three pictures that both of the first two cameras and of the last two show, and these."""
    corners = join_still(session.corners).corners
    first = corners.view_camera < 2
    both = np.intersect1d(corners.view_picture[first], corners.view_picture[~first])
    moving = both[both < 98]
    links = moving[:: len(moving) // 3][:3]
    gone = np.isin(corners.picture, np.setdiff1d(both, links)) & (corners.camera >= 2)
    return corners.subset(~gone), links


@pytest.fixture(scope="module")
def linked(weakly_linked) -> SolvedSession:
    return solve_session(weakly_linked[0], BOARD, model=False)


@pytest.mark.slow
def test_cameras_are_divided_where_the_pictures_between_them_are_left_out(weakly_linked, linked: SolvedSession):
    corners, links = weakly_linked
    assert len(np.unique(linked.joined)) == 1
    pixels = np.array(corners.pixels)
    blurred = np.isin(corners.picture, links) & (corners.camera >= 2)
    pixels[blurred] += np.random.default_rng(0).normal(0, 15, (np.count_nonzero(blurred), 2))
    found = refined_session(linked, replace(corners, pixels=pixels))
    assert found.joined[0] == found.joined[1] != found.joined[2] == found.joined[3]
    floor = 98
    own = np.isin(np.arange(4), corners.camera[corners.picture == floor])
    assert own[:2].any()
    on_floor = in_floor_world(found, floor)
    for each, known in ((found, [False] * 4), (on_floor, [True, True, False, False])):
        sd = np.sqrt(np.diag(each.covariance))[: CAMERA * 4].reshape(4, CAMERA)[:, LENS:]
        assert np.isfinite(sd).all()
        # One camera of each group that nothing holds keeps its pose, and is no measurement.
        assert (sd > 0).all(axis=1).sum() == (3 if known[0] else 2)
        assert (sd > 0).all(axis=1)[:2].sum() == (2 if known[0] else 1)
        assert sd.max() < 0.1


@pytest.mark.slow
def test_divided_cameras_are_connected_again_by_better_corners(
    session: MadeSession, weakly_linked, linked: SolvedSession
):
    corners, _ = weakly_linked
    assert connected_again(linked, corners) == (linked, False)
    found, more = connected_again(replace(linked, joined=np.array([0, 0, 2, 2])), corners)
    assert more
    assert len(np.unique(found.joined)) == 1
    own, true = (np.linalg.norm(places[0] - places[2]) for places in (centres(found.state), session.rig.centres))
    assert own == pytest.approx(true, rel=0.01)


@pytest.mark.slow
def test_cameras_that_recorded_one_after_the_other_agree_on_no_relative_pose(session: MadeSession):
    corners = session.corners
    assert recorded_together(corners, BOARD)
    # The second camera shows the board in the poses of other pictures.
    pictures = np.array(corners.picture)
    pictures[corners.camera == 1] = np.random.default_rng(0).permutation(110)[pictures[corners.camera == 1]]
    order = np.lexsort((corners.corner, corners.camera, pictures))
    apart = replace(corners, picture=pictures).subset(order)
    apart = apart.subset(apart.camera < 2)
    assert not recorded_together(apart, BOARD)
    assert recorded_together(apart.subset(apart.camera == 0), BOARD)
    assert len(apart.separated().pictures) == len(apart.view_starts)


def test_without_corners_the_error_names_the_reason(session: MadeSession):
    with pytest.raises(SettingProblem, match="no corner of the board"):
        solve_session(session.corners.subset(np.zeros(len(session.corners), bool)), BOARD)


def test_displacements_are_zero_for_views_that_agree_and_recovered_for_those_that_do_not():
    rng = np.random.default_rng(7)
    views, pose = 120, np.repeat(np.arange(60), 2)
    for spread in ((0.0, 0.0), (0.02, 0.01)):
        square = np.zeros((views, 27, 27))
        for view in range(views):
            root = rng.normal(0, 1, (12, 6)) * 500
            true = rng.normal(0, 1, 6) * np.repeat(spread, 3)
            rows = np.zeros((12, 27))
            rows[:, 19:25], rows[:, 26] = root, root @ true + rng.normal(0, 1, 12)
            square[view] = rows.T @ rows
        found = estimate_displacement(square, pose, np.zeros((views, 3)))
        # 360 differences of each kind determine a standard deviation to 4 %.
        assert found == pytest.approx(spread, rel=0.2)


@pytest.mark.slow
def test_views_that_do_not_determine_the_cameras_are_refused(session: MadeSession):
    still = join_still(session.corners)
    adjusted = solve_session(still.corners, session.board).adjusted
    common = np.array(adjusted.blocks.common)
    # Nothing is known of the first camera, as if all its views were left out.
    common[:CAMERA], common[:, :CAMERA] = 0.0, 0.0
    mixed = np.array(adjusted.blocks.mixed)
    mixed[:, :CAMERA] = 0.0
    without = replace(adjusted.blocks, common=common, mixed=mixed)
    with pytest.raises(SettingProblem, match="do not determine all cameras"):
        common_covariance(replace(adjusted, blocks=without))
