"""Several cameras: shapes, motion and relative orientations of synthetic sequences, and errors for bad input."""

import numpy as np
import pytest

from marey.errors import MareyError
from marey.geometry import rotations
from marey.nonrigid.many_cameras.many_views import factorise_views

FRAMES, POINTS = 40, 10
MIRROR = np.diag([1.0, 1.0, -1.0])


@pytest.fixture(scope="module")
def made():
    """A slowly deforming cluster that swings before three cameras: path in the first, shapes, cameras, tracks."""
    rng = np.random.default_rng(3)
    time = np.arange(FRAMES)
    swing = np.stack([0.15 * np.sin(time / 11), 0.5 * np.sin(time / 9), 0.2 * np.cos(time / 14)], 1)
    path = rotations.exp(swing)
    weights = np.stack([0.15 * np.sin(time / 6), 0.1 * np.cos(time / 8)], 1)
    shapes = rng.normal(size=(3, POINTS)) + np.einsum("fm,mip->fip", weights, rng.normal(size=(2, 3, POINTS)))
    shapes = 100 * (shapes - shapes.mean(2, keepdims=True))
    cameras = rotations.exp(np.array([[0.0, 0, 0], [0.1, 0.8, 0.2], [-0.2, 1.4, 0.1]]))
    scale = np.array([1, 0.7, 1.2])
    shift = rng.normal(size=(3, FRAMES, 2)).cumsum(1) + 300
    shown = np.einsum("cij,fjp->cfip", scale[:, None, None] * cameras[:, :2], path @ shapes)
    return path, shapes, cameras, scale, shown + shift[..., None]


def error_of(found, path, shapes):
    """Give the mean distance over the mean standard deviation, in the first camera's frame, the sign of depth free."""
    truth, got = path @ shapes, found.rotation @ found.shape
    return (
        min(np.linalg.norm(got - mirror @ truth, axis=1).mean() for mirror in (np.eye(3), MIRROR)) / truth.std(2).mean()
    )


def camera_errors(found, cameras):
    """Give the angles by which the cameras are wrong, of the mirror image that suits."""
    wrong = [
        rotations.log(mirror @ cameras @ mirror @ np.swapaxes(found.camera_from_first, 1, 2))
        for mirror in (np.eye(3), MIRROR)
    ]
    return min((np.linalg.norm(each, axis=1) for each in wrong), key=np.sum)


@pytest.mark.slow
def test_exact_tracks_of_two_cameras_give_shapes_and_cameras(made):
    path, shapes, cameras, scale, tracks = made
    found = factorise_views(tracks[:2])
    assert error_of(found, path, shapes) < 0.03
    assert camera_errors(found, cameras[:2]).max() < 0.03
    np.testing.assert_allclose(found.scale, scale[:2], rtol=1e-3)
    np.testing.assert_allclose(found.rotation[0], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.einsum("fk,kip->fip", found.coefficients, found.basis), found.shape)
    shown = np.einsum(
        "cij,fjp->cfip", found.scale[:, None, None] * found.camera_from_first[:, :2], found.rotation @ found.shape
    )
    left = np.linalg.norm(shown + found.translation[..., None] - tracks[:2], axis=2)
    np.testing.assert_allclose(left, found.residuals, atol=1e-9)
    assert found.point_rms.max() < 1


@pytest.mark.slow
def test_gaps_noise_and_points_of_one_camera_are_reported(made, rng):
    path, shapes, cameras, _, tracks = made
    noise = np.array([0.5, 1.0, 0.5])
    tracks = tracks + noise[:, None, None, None] * rng.normal(size=tracks.shape)
    missing = rng.random((3, FRAMES, POINTS)) < 0.2
    missing[1, :, 0] = missing[2, :, 0] = True
    missing[0, :, 1] = missing[1, :, 1] = True
    missing[0, 20:23] = True
    tracks[np.broadcast_to(missing[:, :, None], tracks.shape)] = np.nan
    found = factorise_views(tracks)
    assert error_of(found, path, shapes) < 0.03
    assert camera_errors(found, cameras).max() < 0.03
    np.testing.assert_allclose(found.noise_sd, noise, rtol=0.25)
    np.testing.assert_array_equal(found.predicted, missing.all(0))
    assert np.isfinite(found.shape).all()
    assert np.isnan(found.residuals[missing]).all()
    np.testing.assert_array_equal(np.isnan(found.translation[..., 0]), missing.all(2))
    turned = found.rotation @ found.shape
    sd = np.sqrt(found.rotation**2 @ found.shape_sd**2)
    wrong = min((turned - mirror @ path @ shapes for mirror in (np.eye(3), MIRROR)), key=lambda w: np.abs(w).sum())
    assert np.mean(np.abs(wrong) < 1.96 * sd) > 0.85


@pytest.mark.slow
def test_a_rigid_object_has_one_basis_shape_and_a_note(made):
    path, shapes, cameras, scale, _ = made
    shape = np.asarray(shapes[0])
    tracks = np.einsum("cij,fjp->cfip", scale[:, None, None] * cameras[:, :2], path @ shape)
    found = factorise_views(tracks[:2, ::2])
    assert found.rank == 1
    assert any("rigid" in note for note in found.notes)
    assert error_of(found, path[::2], np.broadcast_to(shape, shapes.shape)[::2]) < 0.01


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda tracks: tracks[:1], "cameras >= 2"),
        (lambda tracks: tracks[:, :4], "too few"),
        (lambda tracks: tracks[..., :3], "too few"),
        (lambda tracks: np.where(np.arange(FRAMES)[:, None, None] == 7, np.nan, tracks), "frame 7"),
        (lambda tracks: np.where(np.arange(POINTS) == 5, np.nan, tracks), "Point 5"),
        (lambda tracks: tracks * np.array([1, 0, 1])[:, None, None, None], "no shape to estimate"),
        (lambda tracks: np.stack([tracks[0], 0.8 * tracks[0]]), "same side"),
        (lambda tracks: np.stack([tracks[0], tracks[2][:, :, ::-1]]), "do not match"),
        (
            lambda tracks: np.where(
                (np.arange(POINTS) < 6) == np.array([True, False])[:, None, None, None], tracks[:2], np.nan
            ),
            "No two cameras",
        ),
    ],
)
def test_unsuitable_tracks_are_an_error(made, spoil, message):
    with pytest.raises(MareyError, match=message):
        factorise_views(spoil(made[4]))
