"""Calibrated cameras: shapes and motion in the laboratory, with gaps, outliers and points of one camera."""

import numpy as np
import pytest
from tests.nonrigid.made_shapes import three_cameras, without_motion

from marey.cameras.rig import Rig
from marey.errors import MareyError
from marey.geometry import rotations
from marey.nonrigid.core.alignment import rigid_fits
from marey.nonrigid.in_space.calibrated import factorise_calibrated

FRAMES, POINTS = 60, 20
ALL = np.ones((FRAMES, POINTS), bool)


@pytest.fixture
def points(rng):
    """(F, P, 3) [m] of three basis shapes in motion."""
    mean = 0.15 * rng.normal(size=(POINTS, 3))
    mean -= mean.mean(0)
    modes = without_motion(rng.normal(size=(2, POINTS, 3)), mean)
    time = np.arange(FRAMES)
    shape = mean + np.einsum("fm,mpi->fpi", 0.02 * np.stack([np.sin(time / 9), np.cos(time / 5)], 1), modes)
    rotation = rotations.exp(np.cumsum(0.05 * rng.normal(size=(FRAMES, 3)), 0))
    return np.einsum("fij,fpj->fpi", rotation, shape) + 0.01 * np.cumsum(rng.normal(size=(FRAMES, 1, 3)), 0)


def tracks_of(rig, points):
    return np.moveaxis(np.stack([camera.project(points) for camera in rig]), 3, 2)


def in_object(found, points):
    """The true rotation, translation and shape (F, 3, P) of the frame that departs least from the mean shape found."""
    rotation, translation = rigid_fits(found.basis[0].T, points, ALL)
    return rotation, translation, np.einsum("fji,fpj->fip", rotation, points - translation[:, None])


def held(error, sd):
    return np.mean(np.abs(error[np.isfinite(error)] / sd[np.isfinite(error)]) < 1.96)


def test_exact_pixels_give_the_shapes_and_their_absolute_motion(points):
    rig = three_cameras()
    found = factorise_calibrated(tracks_of(rig, points), rig, rank=3)
    np.testing.assert_allclose(found.points, points, atol=2e-6)
    assert found.noise_px <= 0.01
    assert np.nanmax(found.residuals_px) < 0.01
    assert found.camera_names == rig.names


@pytest.mark.slow
def test_gaps_outliers_and_points_of_one_camera_keep_the_standard_deviations_valid(points, rng):
    rig = three_cameras()
    tracks = tracks_of(rig, points)
    tracks += 0.5 * rng.normal(size=tracks.shape)
    slipped = rng.random(tracks[:, :, 0].shape) < 0.01
    tracks += 30 * slipped[:, :, None] * rng.normal(size=tracks.shape)
    tracks[np.repeat((rng.random(slipped.shape) < 0.25)[:, :, None], 2, 2)] = np.nan
    tracks[1:, :, :, -2:] = np.nan  # two points that the first camera alone sees
    tracks[1:, 20:23] = np.nan  # frames in which no rays meet
    found = factorise_calibrated(tracks, rig)
    assert found.rank == 3
    assert found.notes == ()
    assert found.noise_px == pytest.approx(0.5, rel=0.1)
    rotation, translation, shape = in_object(found, points)
    assert np.sqrt(np.mean((found.points - points) ** 2)) < 1.5e-3
    assert 0.85 < held(found.shape - shape, found.shape_sd) <= 0.995
    turn = rotations.log(np.swapaxes(rotation, 1, 2) @ found.rotation)
    assert 0.85 < held(turn - turn.mean(0), found.rotation_sd) <= 0.995
    assert 0.85 < held(found.translation - translation, found.translation_sd) <= 0.995
    slipped &= np.isfinite(tracks[:, :, 0])
    assert np.median(found.residuals_px[slipped]) > 10


def test_given_standard_deviations_are_relative(points, rng):
    rig = three_cameras()
    tracks = tracks_of(rig, points)
    sd = np.where(np.arange(POINTS) < POINTS // 2, 0.2, 4.0) * np.ones(tracks.shape)
    tracks += sd * rng.normal(size=tracks.shape)
    found = factorise_calibrated(tracks, rig, tracks_sd=sd / 10, rank=3)
    assert found.sd_factor == pytest.approx(10, rel=0.15)
    blind = factorise_calibrated(tracks, rig, rank=3)
    good = np.s_[:, : POINTS // 2]
    assert np.std((found.points - points)[good]) < 0.8 * np.std((blind.points - points)[good])


def test_unsuitable_tracks_are_an_error(points):
    rig = three_cameras()
    tracks = tracks_of(rig, points)
    with pytest.raises(MareyError, match=r"\(cameras, frames, 2, points\)"):
        factorise_calibrated(tracks[0], rig)
    with pytest.raises(MareyError, match="tracks of 2 cameras"):
        factorise_calibrated(tracks[:2], rig)
    with pytest.raises(MareyError, match="one camera alone"):
        factorise_calibrated(tracks[:1], Rig(rig.cameras[:1]))
    with pytest.raises(MareyError, match="not in the order"):
        factorise_calibrated(tracks[[2, 0, 1]], rig)
    with pytest.raises(MareyError, match="two sides"):
        factorise_calibrated(np.where(np.arange(3)[:, None, None, None] == 0, tracks, np.nan), rig)
    with pytest.raises(MareyError, match="their standard deviations"):
        factorise_calibrated(tracks, rig, tracks_sd=tracks[:, :, 0])


def test_an_empty_frame_has_no_estimate_and_a_note(points):
    rig = three_cameras()
    tracks = tracks_of(rig, points)
    tracks[:, 7] = np.nan
    found = factorise_calibrated(tracks, rig, rank=2)
    assert np.isnan(found.rotation[7]).all()
    assert "1 of 60 frames" in found.notes[0]
