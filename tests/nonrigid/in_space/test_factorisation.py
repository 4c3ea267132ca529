"""Deforming points in space: reconstruction, missing points, and coverage of the standard deviations."""

import numpy as np
import pytest
from tests.nonrigid.made_shapes import without_motion

from marey.errors import MareyError
from marey.geometry import rotations
from marey.nonrigid.core.alignment import mean_shape, rigid_fits
from marey.nonrigid.in_space.factorisation import factorise_points

FRAMES, POINTS = 80, 12


@pytest.fixture
def made(rng):
    """Poses (F, 3, 3) and (F, 3), shapes (F, P, 3) of three basis shapes, and the points in the laboratory."""
    mean = rng.normal(size=(POINTS, 3))
    mean -= mean.mean(0)
    modes = without_motion(rng.normal(size=(2, POINTS, 3)), mean)
    weights = rng.normal(size=(FRAMES, 2)) * (0.2, 0.1)
    shape = mean + np.einsum("fm,mpi->fpi", weights - weights.mean(0), modes)
    rotation = rotations.exp(np.cumsum(0.1 * rng.normal(size=(FRAMES, 3)), 0))
    rotation = rotation @ rotation[0].T
    translation = rng.normal(size=(FRAMES, 3))
    return rotation, translation, shape, np.einsum("fij,fpj->fpi", rotation, shape) + translation[:, None]


def test_exact_data_are_reconstructed_with_their_motion(made):
    rotation, translation, shape, points = made
    found = factorise_points(points, 3)
    np.testing.assert_allclose(found.points, points, atol=1e-6)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-5)
    np.testing.assert_allclose(found.translation, translation, atol=1e-5)
    np.testing.assert_allclose(found.shape, np.moveaxis(shape, 1, 2), atol=1e-5)
    assert found.rank == 3
    assert found.residuals.max() < 1e-5
    np.testing.assert_allclose(np.einsum("fk,kip->fip", found.coefficients, found.basis), found.shape)


def test_missing_points_are_predicted(made, rng):
    points = made[3]
    missing = rng.random(points.shape[:2]) < 0.3
    given = np.where(missing[..., None], np.nan, points)
    found = factorise_points(given, 3)
    np.testing.assert_array_equal(found.predicted, missing)
    np.testing.assert_allclose(found.points, points, atol=1e-4)
    assert np.isnan(found.residuals[missing]).all()


def test_the_standard_deviations_are_valid(made, rng):
    rotation, translation, shape, points = made
    noise = 0.01
    given = points + noise * rng.normal(size=points.shape)
    given[rng.random(points.shape[:2]) < 0.2] = np.nan
    found = factorise_points(given, 3)
    assert found.noise_sd == pytest.approx(noise, rel=0.1)
    # the axes are those of the reference frame, whose own error all frames share: compare about the mean turn
    turn = rotations.mean(np.swapaxes(rotation, 1, 2) @ found.rotation)
    wrong = rotations.log(turn.T @ np.swapaxes(rotation, 1, 2) @ found.rotation)
    score = wrong / np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)[:, :3])
    assert np.mean(score**2) == pytest.approx(1, abs=0.35)
    score = (found.translation - translation) / np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)[:, 3:])
    assert np.mean(score**2) == pytest.approx(1, abs=0.35)
    score = (np.einsum("ij,fjp->fip", turn, found.shape) - np.moveaxis(shape, 1, 2)) / found.shape_sd
    assert np.mean(score**2) == pytest.approx(1, abs=0.35)


@pytest.mark.slow
def test_the_number_of_shapes_is_chosen_and_predictions_have_valid_standard_deviations(made, rng):
    points = made[3]
    noise = 0.02
    given = points + noise * rng.normal(size=points.shape)
    for point in range(POINTS):
        begin = rng.integers(FRAMES - 15)
        given[begin : begin + 15, point] = np.nan
    found = factorise_points(given)
    assert found.rank == found.choice.rank == 3
    assert found.notes == ()
    np.testing.assert_array_equal(found.choice.ranks, np.arange(1, len(found.choice.ranks) + 1))
    assert found.choice.held_out_rms[2] < 0.5 * found.choice.held_out_rms[0]
    rotation, translation = rigid_fits(found.basis[0].T, points, np.ones(points.shape[:2], bool))
    true = np.einsum("fji,fpj->fip", rotation, points - translation[:, None])
    score = np.moveaxis(np.abs(found.shape - true) / found.shape_sd, 1, 2)[found.predicted]
    assert np.mean(score < 1.96) > 0.85
    assert np.sqrt(np.mean(score**2)) > 0.5


def test_unmodelled_deformation_is_part_of_the_standard_deviation(made, rng):
    points = made[3] + 1e-3 * rng.normal(size=made[3].shape)
    slow = np.sin(2 * np.pi * np.arange(FRAMES) / FRAMES)[:, None, None] * 0.01 * rng.normal(size=(POINTS, 3))
    found = factorise_points(points + np.einsum("fij,fpj->fpi", made[0], slow), 3)
    left = np.sqrt(np.mean(found.residuals**2) / 3)
    assert np.sqrt(np.mean(found.shape_sd**2)) == pytest.approx(left, rel=0.3)


@pytest.mark.slow
def test_rigid_points_have_one_basis_shape_and_a_note(made, rng):
    rotation, translation, shape, _ = made
    points = np.einsum("fij,pj->fpi", rotation, shape[0]) + translation[:, None]
    found = factorise_points(points + 0.01 * rng.normal(size=points.shape))
    assert found.rank == 1
    assert "rigid" in found.notes[-1]


def test_too_few_points_for_cross_validation_are_a_rigid_shape(made):
    found = factorise_points(made[3][:, :4])
    assert found.rank == 1
    assert np.isnan(found.choice.held_out_rms).all()
    with pytest.raises(MareyError, match="three points in common"):
        factorise_points(made[3][:, :2])


def test_the_modes_contain_no_motion_of_the_mean(made, rng):
    points = made[3] + 0.05 * rng.normal(size=made[3].shape)
    found = factorise_points(points, 4, reference=7)
    np.testing.assert_allclose(found.rotation[7], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(found.basis.mean(2), 0, atol=1e-12)
    np.testing.assert_allclose(np.cross(found.basis[0].T, found.basis[1:].swapaxes(1, 2)).sum(1), 0, atol=1e-9)
    np.testing.assert_allclose(np.sqrt((found.basis[1:] ** 2).sum(1).mean(1)), 1)
    assert (np.diff(found.coefficients[:, 1:].std(0)) <= 0).all()


def test_one_basis_shape_is_the_rigid_fit_to_the_mean_shape(made):
    points = made[3]
    found = factorise_points(points, 1)
    mean, rotation, translation = mean_shape(points, np.ones(points.shape[:2], bool))
    np.testing.assert_allclose(found.rotation, rotation @ rotation[0].T, atol=1e-4)
    np.testing.assert_allclose(found.translation, translation, atol=1e-4)
    again, _ = rigid_fits(found.basis[0].T, points, np.ones(points.shape[:2], bool))
    np.testing.assert_allclose(again, found.rotation, atol=1e-4)
    assert mean.shape == (POINTS, 3)


def test_more_basis_shapes_lower_the_residual(made, rng):
    points = made[3] + 0.02 * rng.normal(size=made[3].shape)
    left = [np.sqrt(np.mean(factorise_points(points, rank).residuals ** 2)) for rank in (1, 2, 3)]
    assert left[0] > left[1] > left[2]


def test_a_frame_with_too_few_points_has_no_estimate(made):
    points = made[3].copy()
    points[0, 2:] = np.nan
    points[5] = np.nan
    points[:, 4] = np.nan
    found = factorise_points(points, 2)
    assert found.reference == 1
    assert np.isnan(found.rotation[[0, 5]]).all()
    assert np.isnan(found.shape[[0, 5]]).all()
    assert np.isnan(found.shape[:, :, 4]).all()
    assert np.isnan(found.point_rms[4])
    assert np.isfinite(found.rotation[1:5]).all()
    assert "2 of 80 frames" in found.notes[0]
    assert "1 of 12 points" in found.notes[1]


def test_points_on_a_line_determine_no_rotation():
    points = np.arange(5.0)[:, None] * np.array([1.0, 2.0, 3.0]) + np.zeros((10, 1, 1))
    with pytest.raises(MareyError, match="one line"):
        factorise_points(points, 1)


@pytest.mark.parametrize(("rank", "message"), [(0, "at least 1"), (60, "too many")])
def test_an_impossible_rank_is_an_error(made, rank, message):
    with pytest.raises(MareyError, match=message):
        factorise_points(made[3], rank)


def test_points_of_wrong_shape_are_an_error(made):
    with pytest.raises(MareyError, match=r"\(frames, points, 3\)"):
        factorise_points(np.moveaxis(made[3], 1, 2), 2)
    with pytest.raises(MareyError, match="reference"):
        factorise_points(made[3], 2, reference=900)
