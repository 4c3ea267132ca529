"""Normal equations: the elimination of the board poses and of displacements gives the solution of the whole system."""

from dataclasses import replace

import numpy as np

from marey.calibration.adjustment.equations import HUBER, assemble, view_places, view_systems
from marey.calibration.adjustment.projection import BOARD_COLUMNS, LATE_COLUMN, RESIDUAL_COLUMN
from marey.calibration.adjustment.state import CAMERA, common_size, delay_unknowns, shape_unknowns
from marey.geometry.rotations import hat

CAMERAS, POSES = 2, 3
SIZE = common_size(CAMERAS)


def made_rows(rng: np.random.Generator, count: int) -> np.ndarray:
    rows = rng.normal(0, 1, (count, 2, RESIDUAL_COLUMN + 1))
    rows[..., RESIDUAL_COLUMN] *= 0.2
    return rows


def views() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    view = np.repeat(np.arange(6), [9, 8, 7, 9, 8, 10])
    return view, np.array([0, 1, 0, 1, 0, 1])[view], np.array([0, 0, 1, 1, 2, 2])[view]


def dense(rows: np.ndarray, camera: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Write the rows of all corners into one matrix: cameras, shape, delays, board poses."""
    matrix = np.zeros((len(rows), 2, SIZE + 6 * POSES))
    for k in range(len(rows)):
        matrix[k, :, CAMERA * camera[k] : CAMERA * (camera[k] + 1)] = rows[k, :, :CAMERA]
        matrix[k, :, shape_unknowns(CAMERAS)] = rows[k, :, CAMERA : BOARD_COLUMNS.start]
        matrix[k, :, delay_unknowns(CAMERAS).start + camera[k]] = rows[k, :, LATE_COLUMN]
        matrix[k, :, SIZE + 6 * pose[k] : SIZE + 6 * (pose[k] + 1)] = rows[k, :, BOARD_COLUMNS]
    return matrix.reshape(2 * len(rows), -1), rows[..., RESIDUAL_COLUMN].ravel()


def test_the_reduced_equations_have_the_solution_of_the_whole_system():
    rng = np.random.default_rng(0)
    view, camera, pose = views()
    rows = made_rows(rng, len(view))
    places = view_places(view, camera, pose)
    systems = view_systems(rows, places, np.zeros((6, 3)), (0.0, 0.0))
    blocks = assemble(systems.square, places, cameras=CAMERAS, poses=POSES, fixed=np.zeros(POSES, bool))
    matrix, right = blocks.reduced()
    step = np.linalg.solve(matrix, right)
    whole = np.linalg.lstsq(*dense(rows, camera, pose), rcond=None)[0]
    np.testing.assert_allclose(step, whole[:SIZE], atol=1e-6)
    np.testing.assert_allclose(blocks.board_steps(step).ravel(), whole[SIZE:], atol=1e-6)


def test_a_fixed_pose_does_not_move():
    rng = np.random.default_rng(1)
    view, camera, pose = views()
    rows = made_rows(rng, len(view))
    places = view_places(view, camera, pose)
    systems = view_systems(rows, places, np.zeros((6, 3)), (0.0, 0.0))
    blocks = assemble(systems.square, places, cameras=CAMERAS, poses=POSES, fixed=np.array([True, False, False]))
    step = np.linalg.solve(*blocks.reduced())
    matrix, right = dense(rows, camera, pose)
    keep = np.r_[:SIZE, SIZE + 6 : SIZE + 18]
    np.testing.assert_allclose(step, np.linalg.lstsq(matrix[:, keep], right, rcond=None)[0][:SIZE], atol=1e-6)
    np.testing.assert_array_equal(blocks.board_steps(step)[0], 0.0)


def test_elimination_of_displacements_is_that_of_six_more_unknowns_with_a_prior():
    rng = np.random.default_rng(2)
    view, camera, pose = views()
    rows = made_rows(rng, len(view))
    places = view_places(view, camera, pose)
    arm, spread = rng.normal(0, 0.3, (6, 3)), (0.1, 0.05)
    square = view_systems(rows, places, arm, spread).square
    for number in range(6):
        own = rows[view == number].reshape(-1, RESIDUAL_COLUMN + 1)
        board = own[:, BOARD_COLUMNS]
        loose = np.concatenate(
            [(board[:, :3] + board[:, 3:] @ hat(arm[number])) * spread[0], board[:, 3:] * spread[1]], 1
        )
        covariance = np.eye(len(own)) + loose @ loose.T
        np.testing.assert_allclose(square[number], own.T @ np.linalg.solve(covariance, own), atol=1e-8)


def test_a_corner_behind_the_camera_has_no_weight():
    rng = np.random.default_rng(3)
    view, camera, pose = views()
    rows = made_rows(rng, len(view))
    rows[4] = np.nan
    places = view_places(view, camera, pose)
    found = view_systems(rows, places, np.zeros((6, 3)), (0.0, 0.0))
    own = np.delete(rows[:9], 4, axis=0).reshape(-1, RESIDUAL_COLUMN + 1)
    np.testing.assert_allclose(found.square[0], own.T @ own, atol=1e-10)
    assert np.isfinite(found.cost)


def test_weights_and_displacements_are_those_of_the_plain_formulas():
    rng = np.random.default_rng(4)
    view, camera, pose = views()
    rows = made_rows(rng, len(view))
    rows[..., RESIDUAL_COLUMN] *= 20.0
    places = replace(view_places(view, camera, pose), loose=np.arange(6) != 2)
    arm, spread = rng.normal(0, 0.3, (6, 3)), (0.1, 0.05)
    found, cost = view_systems(rows, places, arm, spread), 0.0
    for number in range(6):
        own = rows[view == number].reshape(-1, RESIDUAL_COLUMN + 1)
        board, residual, weight = own[:, BOARD_COLUMNS], own[:, RESIDUAL_COLUMN], np.ones(len(own))
        turn = board[:, :3] + board[:, 3:] @ hat(arm[number])
        loose = (number != 2) * np.concatenate([turn * spread[0], board[:, 3:] * spread[1]], 1)
        for _ in range(3):
            step = np.linalg.solve(np.eye(6) + loose.T @ (loose * weight[:, None]), loose.T @ (weight * residual))
            left = residual - loose @ step
            length = np.linalg.norm(left.reshape(-1, 2), axis=1)
            weight = np.repeat(np.minimum(1.0, HUBER / length), 2)
        assert (weight < 1).any()
        cost += np.where(length < HUBER, length**2, HUBER * (2 * length - HUBER)).sum() + np.sum(step**2)
        np.testing.assert_allclose(found.own[view == number].ravel(), left, atol=1e-9)
        np.testing.assert_allclose(found.displacement[number], step, atol=1e-9)
        covariance = np.diag(1.0 / weight) + loose @ loose.T
        np.testing.assert_allclose(found.square[number], own.T @ np.linalg.solve(covariance, own), atol=1e-7)
    assert abs(found.cost - cost) < 1e-7 * cost


def test_views_of_one_camera_and_pose_add_up():
    rng = np.random.default_rng(5)
    camera, pose = np.array([0, 1, 0, 1, 0, 0]), np.array([0, 0, 1, 2, 1, 1])
    view = np.repeat(np.arange(6), 9)
    rows = made_rows(rng, len(view))
    places = view_places(view, camera[view], pose[view])
    systems = view_systems(rows, places, np.zeros((6, 3)), (0.0, 0.0))
    blocks = assemble(systems.square, places, cameras=CAMERAS, poses=POSES, fixed=np.zeros(POSES, bool))
    # All corners are within Huber's distance.
    matrix, residual = dense(rows, camera[view], pose[view])
    normal, right = matrix.T @ matrix, matrix.T @ residual
    np.testing.assert_allclose(blocks.common, normal[:SIZE, :SIZE], atol=1e-9)
    np.testing.assert_allclose(blocks.common_right, right[:SIZE], atol=1e-9)
    for number in range(POSES):
        own = slice(SIZE + 6 * number, SIZE + 6 * (number + 1))
        np.testing.assert_allclose(blocks.mixed[number], normal[:SIZE, own], atol=1e-9)
        np.testing.assert_allclose(blocks.board[number], normal[own, own], atol=1e-9)
        np.testing.assert_allclose(blocks.board_right[number], right[own], atol=1e-9)
