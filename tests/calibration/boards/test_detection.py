"""Boards in rendered pictures: the corners that a camera sees, by detection and by registration of the print."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from tests.made_boards import BOARD, made_rig

from marey.arrays import Floats, Image
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.detection import find_board, find_mirrored, known_dictionary
from marey.calibration.boards.printed import own_view, render_board, visible_corners
from marey.calibration.boards.registration import register_board
from marey.cameras.camera import Camera
from marey.errors import SettingProblem
from marey.geometry.rigid import RigidTransform

KINDS = {
    "charuco": BOARD,
    "inverted": replace(BOARD, inverted=True),
    "chessboard": CalibrationBoard(kind="chessboard", columns=8, rows=5, square=0.1),
    "aruco": CalibrationBoard(kind="markers", columns=5, rows=4, square=0.12, gap=0.04, dictionary="DICT_4X4_50"),
    "apriltag": CalibrationBoard(
        kind="markers", columns=4, rows=3, square=0.15, gap=0.05, dictionary="DICT_APRILTAG_36H11"
    ),
}
POSE = RigidTransform.from_vector(np.array([0.35, -0.3, 0.2]), np.array([-0.45, -0.3, 1.9]))


@pytest.fixture(scope="module")
def camera() -> Camera:
    return own_view(made_rig(1, np.random.default_rng(3)).cameras[0])


def picture_of(
    board: CalibrationBoard, camera: Camera, pose: RigidTransform, *, noise: float = 2.0, blur: float = 0.6
) -> Image:
    """A picture of a board on a grey ground, blurred and with noise."""
    rendered = render_board(board, camera, pose)
    assert rendered is not None
    ground = np.full((camera.height, camera.width), 110.0)
    x, y = rendered.corner
    height, width = rendered.grey.shape
    part = 35.0 + 180.0 * rendered.grey
    ground[y : y + height, x : x + width] = np.where(rendered.on_board, part, 215.0)
    ground = cv2.GaussianBlur(ground, (0, 0), blur)
    noisy = ground + np.random.default_rng(0).normal(0, noise, ground.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def errors(corner: np.ndarray, pixels: Floats, board: CalibrationBoard, camera: Camera) -> Floats:
    return np.linalg.norm(pixels - camera.project(POSE.apply(board.points[corner])), axis=1)


@pytest.mark.parametrize("kind", KINDS)
def test_the_corners_of_a_board_are_found(kind: str, camera: Camera):
    board = KINDS[kind]
    found = find_board(picture_of(board, camera, POSE), board)
    assert found is not None
    assert len(found) == len(board.front)
    # OpenCV's corners lie 0.1 px (median) from the true ones in sharp pictures of the rendered session; the corners of
    # single markers, at which two edges meet and not four, lie farther off.
    limit = 0.25 if board.kind != "markers" else 0.4
    assert np.median(errors(found.corner, found.pixels, board, camera)) < limit
    assert np.linalg.eigvalsh(found.covariance).min() > 0


@pytest.mark.parametrize("kind", KINDS)
def test_registration_measures_the_corners_within_their_covariance(kind: str, camera: Camera):
    board = KINDS[kind]
    start = RigidTransform.from_vector(np.array([0.003, -0.002, 0.002]), np.array([0.002, -0.003, 0.004])) @ POSE
    found = register_board(picture_of(board, camera, POSE), board, camera, start)
    assert found is not None
    sighting = found.sighting
    # The outer corners of a grid of markers have no print beside them.
    assert len(sighting) >= 0.8 * len(board.front)
    apart = sighting.pixels - camera.project(POSE.apply(board.points[sighting.corner]))
    assert np.sqrt(np.mean(np.sum(apart**2, axis=1))) < (0.06 if board.kind != "markers" else 0.12)
    scaled = np.einsum("ni,nij,nj->n", apart, np.linalg.inv(sighting.covariance), apart)
    # The corners of single markers have less print around them than the model of their errors assumes.
    assert np.mean(scaled) / 2 < (3.0 if board.kind != "markers" else 5.0)


def test_the_blur_of_a_picture_is_estimated(camera: Camera):
    for blur in (0.6, 1.5):
        found = register_board(picture_of(BOARD, camera, POSE, blur=blur), BOARD, camera, POSE)
        assert found is not None
        np.testing.assert_allclose(found.blur, blur**2 * np.eye(2), atol=0.15 * blur**2 + 0.12)


def test_a_blurred_picture_has_larger_errors(camera: Camera):
    sharp, soft = (find_board(picture_of(BOARD, camera, POSE, blur=blur), BOARD) for blur in (0.6, 2.0))
    assert sharp is not None
    assert soft is not None
    assert np.median(np.trace(soft.covariance, axis1=1, axis2=2)) > np.median(
        np.trace(sharp.covariance, axis1=1, axis2=2)
    )


def test_a_picture_without_the_board_gives_nothing(camera: Camera):
    empty = np.random.default_rng(1).integers(0, 255, (camera.height, camera.width), np.uint8)
    assert find_board(empty, BOARD) is None
    assert register_board(empty, BOARD, camera, POSE) is None


def test_a_mirrored_print_is_only_found_in_the_mirror_image(camera: Camera):
    mirrored = np.ascontiguousarray(picture_of(BOARD, camera, POSE)[:, ::-1])
    assert find_board(mirrored, BOARD) is None
    assert find_mirrored(mirrored, BOARD) == len(BOARD.front)


def test_the_back_of_a_two_sided_board_has_corners_of_its_own(camera: Camera):
    board = replace(BOARD, two_sided=True, thickness=0.006)
    turned = RigidTransform.from_vector(np.array([0.0, np.pi, 0.0]), np.zeros(3))
    behind = RigidTransform(POSE.rotation, POSE.translation) @ RigidTransform(np.eye(3), board.centre) @ turned
    behind = behind @ RigidTransform(np.eye(3), -board.centre)
    corner, pixels = visible_corners(board, camera, behind)
    assert (corner >= len(board.front)).all()
    mirrored = picture_of(BOARD, camera, POSE)
    # Seen from behind, the mirror image on the back reads like a mirrored front.
    found = find_board(np.ascontiguousarray(mirrored[:, ::-1]), board)
    assert found is not None
    assert (found.corner >= len(board.front)).all()
    assert len(pixels) == len(corner)


@pytest.mark.slow
def test_the_half_turn_of_a_chessboard_is_seen_by_its_colours(camera: Camera):
    board = KINDS["chessboard"]
    picture = picture_of(board, camera, POSE)
    turned = find_board(np.ascontiguousarray(picture[::-1, ::-1]), board)
    assert turned is not None
    back = np.array([camera.width, camera.height]) - 1 - turned.pixels
    assert np.median(errors(turned.corner, back, board, camera)) < 0.25


def test_an_unknown_dictionary_is_named():
    assert known_dictionary("5X5_250") is not None
    with pytest.raises(SettingProblem, match="no dictionary 'DICT_9X9'"):
        known_dictionary("DICT_9X9")


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"square": -0.1}, "must be positive"),
        ({"marker": 0.2}, "must be smaller"),
        ({"columns": 1}, "at least 2 x 2"),
        ({"thickness": -1.0}, "must not be negative"),
    ],
)
def test_an_impossible_board_is_refused(change: dict[str, float], text: str):
    with pytest.raises(SettingProblem, match=text):
        replace(BOARD, **change)
