"""Cameras refined by the tangents of the silhouettes of a made walk."""

from dataclasses import replace

import numpy as np
import pytest
from tests import made_walk
from tests.fit.cameras.test_from_joints import errors

from marey.cameras.parameters import stepped_camera
from marey.fit.cameras.from_joints import block_basis, camera_basis
from marey.fit.cameras.from_silhouettes import refine_by_tangents, refocused
from marey.fit.cameras.frontier import SilhouetteHulls

TURN_SD, SHIFT_SD, FOCAL_SD = 0.01, 0.03, 0.02


@pytest.fixture(scope="module")
def refined():
    true = made_walk.cameras()
    masks = [own[::4] for own in made_walk.silhouettes(true, made_walk.clocks([0.0] * 4))]
    rng = np.random.default_rng(1)
    change = rng.normal(size=(4, 7)) * ([TURN_SD] * 3 + [SHIFT_SD] * 3 + [FOCAL_SD])
    wrong = [stepped_camera(camera, camera_basis(camera) @ own) for camera, own in zip(true, change, strict=True)]
    basis = block_basis(wrong)
    covariance = basis @ np.diag(([TURN_SD**2] * 3 + [SHIFT_SD**2] * 3 + [FOCAL_SD**2]) * 4) @ basis.T
    hulls = [SilhouetteHulls.of(camera, own) for camera, own in zip(wrong, masks, strict=True)]
    return true, wrong, refine_by_tangents(wrong, covariance, hulls, rounds=5)


def test_cameras_are_better_than_before(refined):
    true, wrong, found = refined
    before, after = errors(wrong, true), errors(found.cameras, true)
    assert np.linalg.norm(after[0]) < 0.75 * np.linalg.norm(before[0])
    assert np.linalg.norm(after[1]) < 0.75 * np.linalg.norm(before[1])


def test_tangents_agree_to_a_fraction_of_a_pixel(refined):
    found = refined[2]
    assert found.after_px < 0.3 < found.before_px


def test_the_stated_standard_deviations_hold_the_errors(refined):
    true, _, found = refined
    inverse = np.linalg.pinv(block_basis(found.cameras))
    sd = np.sqrt(np.maximum(np.diag(inverse @ found.covariance @ inverse.T), 0.0)).reshape(-1, 7)
    turn, shift, _ = errors(found.cameras, true)
    assert np.all(turn < 3 * np.linalg.norm(sd[:, :3], axis=1))
    assert np.all(shift < 3 * np.linalg.norm(sd[:, 3:6], axis=1))


def test_cameras_without_silhouettes_stay(refined):
    true = refined[0]
    nothing = [np.zeros((camera.height, camera.width), bool) for camera in true]
    hulls = [SilhouetteHulls.of(camera, [mask] * 3) for camera, mask in zip(true, nothing, strict=True)]
    basis = block_basis(true)
    found = refine_by_tangents(true, basis @ np.diag([1e-4] * 28) @ basis.T, hulls)
    assert all(np.allclose(a.packed, b.packed) for a, b in zip(found.cameras, true, strict=True))
    assert np.isnan(found.after_px)


def test_hulls_follow_another_focal_length(refined):
    """A camera whose image is scaled about its centre sees the same with a scaled focal length."""
    true = refined[0]
    matrix = np.array(true[0].matrix)
    matrix[:2, :2] *= 1.1
    longer = replace(true[0], matrix=matrix)
    mask = made_walk.drawn(true[0], made_walk.skin(0.0))
    ours = refocused(SilhouetteHulls.of(true[0], [mask]), true[0], longer)
    theirs = SilhouetteHulls.of(longer, [mask])
    np.testing.assert_allclose(ours.directions, theirs.directions, atol=1e-9)
    np.testing.assert_allclose(ours.turn_per_pixel, theirs.turn_per_pixel)
