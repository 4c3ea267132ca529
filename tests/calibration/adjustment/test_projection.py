"""Projection of corners: the same pixels as the camera, and derivatives against differences."""

import numpy as np
import pytest
from tests.made_boards import BOARD, made_rig, walked

from marey.calibration.adjustment.projection import (
    CornerPlaces,
    project_corners,
    project_corners_with_derivative,
)
from marey.calibration.adjustment.state import CAMERA, LENS, SHAPE, SessionState
from marey.calibration.boards.board import CalibrationBoard
from marey.geometry.rigid import RigidTransform

STEP = 1e-6


@pytest.fixture(scope="module")
def state() -> SessionState:
    rng = np.random.default_rng(1)
    rig, poses = made_rig(3, rng), walked(8, rng, BOARD, floor=2)
    lens = np.array(
        [[c.matrix[0, 0], c.matrix[1, 1], c.matrix[0, 2], c.matrix[1, 2], *c.distortion, 0.02] for c in rig]
    )
    return SessionState(
        lens=lens,
        camera_rotation=np.stack([c.camera_from_world.rotation for c in rig]),
        camera_translation=np.stack([c.camera_from_world.translation for c in rig]),
        board_rotation=np.stack([pose.rotation for pose in poses]),
        board_translation=np.stack([pose.translation for pose in poses]),
        shape=np.array([1e-3, 0.01, -0.02, 0.015]),
        delay=np.zeros(3),
    )


@pytest.fixture(scope="module")
def places() -> CornerPlaces:
    return CornerPlaces(
        camera=np.array([0, 1, 2, 0, 1]), pose=np.array([0, 1, 2, 7, 6]), points=BOARD.points[[0, 9, 17, 30, 39]],
        centre=BOARD.centre,
    )  # fmt: skip


def test_the_pixels_are_those_of_the_cameras(state: SessionState, places: CornerPlaces):
    flat = SessionState(**{**vars(state), "shape": np.zeros(SHAPE)})
    rig = flat.rig(("a", "b", "c"), [(1280, 720)] * 3)
    pixels, seen = project_corners(flat, places)
    for k in range(len(pixels)):
        world = flat.board_pose(int(places.pose[k])).apply(places.points[k])
        camera = rig.cameras[places.camera[k]]
        if seen[k, 2] > 0:
            np.testing.assert_allclose(pixels[k], camera.project(world), atol=1e-8)
        else:
            assert np.isnan(pixels[k]).all()


def test_the_derivatives_are_the_limits_of_differences(state: SessionState, places: CornerPlaces):
    pixels, slopes = project_corners_with_derivative(state, places)
    np.testing.assert_allclose(pixels, project_corners(state, places)[0], atol=1e-9)
    columns = state.size
    for row in range(len(places.camera)):
        camera, pose = places.camera[row], places.pose[row]
        for column in range(CAMERA + SHAPE + 6):
            common, board = np.zeros(columns), np.zeros((state.poses, 6))
            scale = 100.0 if column < 4 else 1.0
            if column < CAMERA:
                common[CAMERA * camera + column] = scale * STEP
            elif column < CAMERA + SHAPE:
                common[CAMERA * state.cameras + column - CAMERA] = STEP
            else:
                board[pose, column - CAMERA - SHAPE] = STEP
            ahead = project_corners(state.stepped(common, board), places)[0][row]
            behind = project_corners(state.stepped(-common, -board), places)[0][row]
            difference = (ahead - behind) / (2 * scale * STEP)
            bound = 1e-5 * max(1.0, float(np.abs(slopes[row, :, column]).max()))
            np.testing.assert_allclose(slopes[row, :, column], difference, atol=bound)


def test_a_move_of_the_world_changes_no_pixel(state: SessionState, places: CornerPlaces):
    moved = state.moved(RigidTransform.from_vector(np.array([0.3, -0.2, 1.1]), np.array([1.0, 2.0, -0.5])))
    np.testing.assert_allclose(project_corners(moved, places)[0], project_corners(state, places)[0], atol=1e-8)


def test_a_point_behind_the_camera_has_no_pixel(state: SessionState):
    board = CalibrationBoard(kind="chessboard", columns=4, rows=4, square=0.1)
    behind = RigidTransform(state.camera_rotation[0], state.camera_translation[0]).inverse().apply([0.0, 0.0, -2.0])
    own = SessionState(
        lens=state.lens[:1], camera_rotation=state.camera_rotation[:1], camera_translation=state.camera_translation[:1],
        board_rotation=np.eye(3)[None], board_translation=behind[None], shape=np.zeros(SHAPE),
        delay=np.zeros(1),
    )  # fmt: skip
    place = CornerPlaces(
        camera=np.zeros(1, int), pose=np.zeros(1, int), points=np.zeros((1, 3)), centre=board.centre
    )  # fmt: skip
    assert np.isnan(project_corners(own, place)[0]).all()
    assert LENS == 9
