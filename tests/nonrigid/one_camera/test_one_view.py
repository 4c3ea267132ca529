"""One orthographic camera: shapes and motion of synthetic sequences, with gaps and noise, and errors for bad input."""

import numpy as np
import pytest

from marey.errors import MareyError
from marey.geometry import rotations
from marey.nonrigid.core.refinement import RefinementSettings
from marey.nonrigid.one_camera.one_view import OneViewSettings, factorise_tracks

FRAMES, POINTS = 90, 14


@pytest.fixture(scope="module")
def made():
    """A slowly deforming cluster before a camera that goes round it unevenly: rotation, shapes, tracks."""
    rng = np.random.default_rng(3)
    time = np.arange(FRAMES)
    axis = np.stack([0.1 * np.sin(time / 15), np.ones(FRAMES), 0.1 * np.cos(time / 20)], 1)
    path = rotations.exp(
        axis / np.linalg.norm(axis, axis=1)[:, None] * (0.08 * time + 0.1 * np.sin(time / 12))[:, None]
    )
    weights = np.stack([0.25 * np.sin(time / 9), 0.15 * np.cos(time / 14)], 1)
    shapes = rng.normal(size=(3, POINTS)) + np.einsum("fm,mip->fip", weights, rng.normal(size=(2, 3, POINTS)))
    shapes = 100 * (shapes - shapes.mean(2, keepdims=True))
    shift = 300 + np.cumsum(rng.normal(size=(FRAMES, 2)), 0)
    return path, shapes, (path @ shapes)[:, :2] + shift[:, :, None]


def error_of(found, rotation, shapes):
    """Give the mean distance over the mean standard deviation, in the camera's frame, the sign of depth free."""
    truth, got = rotation @ shapes, found.rotation @ found.shape
    size = truth.std(2).mean()
    mirror = np.array([1.0, 1.0, -1.0])[:, None]
    return min(np.linalg.norm(got * sign - truth, axis=1).mean() for sign in (1, mirror)) / size


@pytest.mark.slow
def test_exact_tracks_give_the_shapes(made):
    found = factorise_tracks(made[2])
    assert error_of(found, made[0], made[1]) < 0.02
    np.testing.assert_allclose(found.rotation[0], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.einsum("fk,kip->fip", found.coefficients, found.basis), found.shape)
    fit = (found.rotation @ found.shape)[:, :2] + found.translation[:, :, None]
    np.testing.assert_allclose(np.linalg.norm(fit - made[2], axis=1), found.residuals, atol=1e-9)
    assert found.point_rms.max() < 1
    assert 3 <= found.rank <= 8
    centred = made[2] - made[2].mean(2, keepdims=True)
    assert found.noise_sd == pytest.approx(0.005 * np.sqrt(np.mean(centred**2)), rel=1e-6)


@pytest.mark.slow
def test_the_least_noise_is_a_setting(made):
    loose = OneViewSettings(refinement=RefinementSettings(least_noise=0.02))
    found, size = factorise_tracks(made[2], settings=loose), np.std(made[2] - made[2].mean(2, keepdims=True))
    assert found.noise_sd == pytest.approx(0.02 * size, rel=1e-6)
    assert error_of(found, made[0], made[1]) < 0.05


@pytest.mark.slow
def test_gaps_and_noise_are_reported(made, rng):
    tracks = made[2] + rng.normal(size=made[2].shape)
    missing = rng.random((FRAMES, POINTS)) < 0.2
    tracks[np.broadcast_to(missing[:, None], tracks.shape)] = np.nan
    found = factorise_tracks(tracks)
    assert error_of(found, made[0], made[1]) < 0.06
    assert found.noise_sd == pytest.approx(1, rel=0.15)
    np.testing.assert_array_equal(found.predicted, missing)
    mirror, errors = np.diag([1.0, 1.0, -1.0]), []
    for rotation in (found.rotation, mirror @ found.rotation @ mirror):
        turn = rotations.mean(np.swapaxes(rotation, 1, 2) @ made[0])
        wrong = rotations.log(made[0] @ np.swapaxes(rotation @ turn, 1, 2))
        errors.append(float(np.sqrt(np.mean(wrong**2))))
    assert min(errors) < 4 * np.sqrt(np.mean(found.rotation_sd**2))
    assert np.degrees(np.sqrt(np.mean(found.rotation_sd**2))) < 3
    chosen = found.rank_curve[np.argmin(found.rank_curve[:, 1]), 0]
    assert 3 <= found.rank <= chosen
    assert np.isfinite(found.shape).all()
    assert np.isnan(found.residuals[missing]).all()


@pytest.mark.slow
def test_a_rigid_object_has_one_basis_shape_and_a_note(made):
    shape = np.asarray(made[1][0])
    found = factorise_tracks((made[0] @ shape)[:, :2])
    assert found.rank == 1
    assert any("rigid" in note for note in found.notes)
    assert error_of(found, made[0], np.broadcast_to(shape, made[1].shape)) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.2])
def test_noise_and_gaps_do_not_make_a_rigid_object_deform(made, rng, share):
    tracks = (made[0] @ np.asarray(made[1][0]))[:, :2]
    tracks = tracks + rng.normal(0, 0.01 * np.std(tracks), tracks.shape)
    gone = rng.random((FRAMES, POINTS)) < share
    found = factorise_tracks(np.where(gone[:, None], np.nan, tracks))
    assert found.rank == 1
    assert any("rigid" in note for note in found.notes)


@pytest.mark.slow
def test_a_basis_shape_of_fewer_dimensions_is_reported(made, rng):
    flat = np.outer([0.3, 0.2, 0.4], rng.normal(size=POINTS))
    shapes = made[1][0] + 100 * np.sin(np.arange(FRAMES) / 9)[:, None, None] * flat
    found = factorise_tracks((made[0] @ (shapes - shapes.mean(2, keepdims=True)))[:, :2])
    assert any("rank 4" in note for note in found.notes)


def test_a_camera_that_sees_one_side_is_an_error(made, rng):
    flat = np.tile(made[1][0][:2], (FRAMES, 1, 1)) + rng.normal(size=(FRAMES, 2, 1))
    with pytest.raises(MareyError, match="one side only"):
        factorise_tracks(flat)
    with pytest.raises(MareyError, match="one side only"):
        factorise_tracks(flat + rng.normal(size=flat.shape))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda tracks: tracks[:4], "too few"),
        (lambda tracks: tracks[:, :, :3], "too few"),
        (lambda tracks: np.moveaxis(tracks, 1, 2), r"\(frames, 2, points\)"),
        (lambda tracks: np.where(np.arange(FRAMES)[:, None, None] == 7, np.nan, tracks), "frame 7"),
        (lambda tracks: np.where(np.arange(POINTS) == 5, np.nan, tracks), "Point 5"),
        (lambda tracks: 0 * tracks, "no shape to estimate"),
    ],
)
def test_unsuitable_tracks_are_an_error(made, spoil, message):
    with pytest.raises(MareyError, match=message):
        factorise_tracks(spoil(made[2]))
