"""One camera in full perspective: bent sheets and bodies, the sign of depth, and errors for bad input."""

import numpy as np
import pytest

from marey.errors import MareyError
from marey.geometry import rotations
from marey.nonrigid.core.track_checks import RIGID
from marey.nonrigid.one_camera.perspective import NO_PERSPECTIVE, factorise_perspective

FRAMES = 18
MATRIX = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
TIME = np.arange(FRAMES) / FRAMES


def rolled(curvature):
    """Give a sheet (3, 30) rolled about a slanted axis, its length kept."""
    u, v = (side.ravel() for side in np.meshgrid(np.linspace(-0.3, 0.3, 6), np.linspace(-0.25, 0.25, 5)))
    across, beside = 0.8 * u + 0.6 * v, 0.8 * v - 0.6 * u
    x = np.sin(curvature * across) / curvature
    z = (1 - np.cos(curvature * across)) / curvature
    return np.stack([0.8 * x - 0.6 * beside, 0.6 * x + 0.8 * beside, z])


def project(points):
    image = MATRIX @ points
    return image[:, :2] / image[:, 2:]


def percent(found, points):
    """Give the mean distance after one scale and one motion per frame, in per cent of the extent; no mirror image."""
    a, b = (x - x.mean(2, keepdims=True) for x in (found.points, points))
    turned = rotations.nearest(b @ np.swapaxes(a, 1, 2)) @ a
    scale = (turned * b).sum() / (turned**2).sum()
    return 100 * np.linalg.norm(scale * turned - b, axis=1).mean() / np.ptp(points, axis=2).max()


@pytest.fixture(scope="module")
def sheet():
    """Points (F, 3, P) of a sheet that bends and turns a little, before the camera."""
    shapes = np.stack([rolled(c) for c in 3.0 * np.sin(2 * np.pi * (TIME + 0.01))])
    turn = rotations.exp(np.outer(np.sin(2 * np.pi * TIME), [0.3, 0.2, 0.1]))
    path = np.stack([0.1 * np.sin(5 * TIME), 0.1 * TIME, 1.2 + 0.2 * np.sin(4 * TIME)], 1)
    return turn @ (shapes - shapes.mean(2, keepdims=True)) + path[:, :, None]


@pytest.fixture(scope="module")
def found(sheet):
    rng = np.random.default_rng(1)
    tracks = project(sheet) + 0.3 * rng.normal(size=(FRAMES, 2, sheet.shape[2]))
    tracks[5:9, :, 7] = np.nan
    return tracks, factorise_perspective(tracks, MATRIX)


@pytest.mark.slow
def test_a_bent_sheet_is_found_with_noise_and_gaps(found, sheet):
    tracks, answer = found
    assert percent(answer, sheet) < 2
    assert answer.mirror_gap > 10
    assert NO_PERSPECTIVE not in answer.notes
    assert answer.stretch < 0.03
    np.testing.assert_array_equal(answer.predicted, np.isnan(tracks[:, 0]))


@pytest.mark.slow
def test_the_result_is_consistent_and_in_its_gauge(found):
    tracks, answer = found
    np.testing.assert_allclose(answer.rotation[0], np.eye(3), atol=1e-12)
    assert answer.translation[:, 2].mean() == pytest.approx(500)
    np.testing.assert_allclose(np.einsum("fk,kip->fip", answer.coefficients, answer.basis), answer.shape, atol=1e-9)
    image = MATRIX @ answer.points
    away = np.linalg.norm(tracks - image[:, :2] / image[:, 2:], axis=1)
    np.testing.assert_allclose(answer.residuals, away, atol=1e-9)
    assert answer.point_rms.max() < 1.5
    assert (answer.shape_sd > 0).all()


@pytest.mark.slow
def test_a_rigid_body_has_one_basis_shape_and_a_note(rng):
    shape = rng.normal(size=(3, 16)) * np.array([[1.0], [0.8], [0.6]])
    turn = rotations.exp(np.outer(2.5 * TIME + np.sin(4 * TIME), [0.2, 0.9, 0.1]))
    points = turn @ (shape - shape.mean(1)[:, None]) + np.array([0.2, 0.1, 6.0])[:, None]
    answer = factorise_perspective(project(points) + 0.2 * rng.normal(size=(FRAMES, 2, 16)), MATRIX)
    assert answer.rank == 1
    assert RIGID in answer.notes
    assert percent(answer, points) < 0.5


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_flat_image_is_an_error(rng, noise):
    flat = rng.normal(size=(2, 20))
    angle, scale = np.sin(3 * TIME), 50 + 10 * TIME
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]).transpose(2, 0, 1)
    tracks = 300 + scale[:, None, None] * (turn @ flat) + noise * rng.normal(size=(FRAMES, 2, 20))
    with pytest.raises(MareyError, match="flat image"):
        factorise_perspective(tracks, MATRIX)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda tracks: tracks[:4], "too few"),
        (lambda tracks: tracks[:, :, :3], "too few"),
        (lambda tracks: np.moveaxis(tracks, 1, 2), r"\(frames, 2, points\)"),
        (lambda tracks: np.where(np.arange(FRAMES)[:, None, None] == 7, np.nan, tracks), "frame 7"),
        (lambda tracks: np.where(np.arange(30) == 5, np.nan, tracks), "Point 5"),
        (lambda tracks: 0 * tracks, "no shape to estimate"),
    ],
)
def test_unsuitable_tracks_are_an_error(sheet, spoil, message):
    with pytest.raises(MareyError, match=message):
        factorise_perspective(spoil(project(sheet)), MATRIX)


@pytest.mark.parametrize(
    "matrix", [np.eye(4), np.full((3, 3), np.nan), MATRIX.T, np.diag([-500.0, 500, 1]), np.diag([500.0, 500, 0])]
)
def test_an_impossible_matrix_is_an_error(sheet, matrix):
    with pytest.raises(MareyError, match="camera matrix"):
        factorise_perspective(project(sheet), matrix)
