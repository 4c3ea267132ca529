"""The common form of all results: selection, expansion to all frames and points, and scale."""

import numpy as np
import pytest

from marey.errors import MareyError
from marey.geometry import rotations
from marey.nonrigid.many_cameras.held_size import HeldSizeShapes
from marey.nonrigid.many_cameras.many_views import ManyViewShapes
from marey.nonrigid.one_camera.one_view import factorise_tracks
from marey.nonrigid.recovered import (
    expanded,
    from_held_size,
    from_many_views,
    from_one_view,
    usable_places,
    with_known_distance,
)


def test_frames_and_points_with_too_few_measurements_are_excluded_until_convergence():
    seen = np.ones((8, 6), bool)
    seen[0, :3] = False
    seen[1:, 5] = False
    frames, points = usable_places(seen[None], least_points=4, least_frames=3)
    assert np.flatnonzero(~frames).tolist() == [0]
    assert np.flatnonzero(~points).tolist() == [5]


def test_too_few_frames_are_an_error():
    with pytest.raises(MareyError, match="6 points over 2 frames are too few"):
        usable_places(np.ones((1, 2, 6), bool), least_points=4, least_frames=3)


@pytest.fixture(scope="module")
def found():
    rng = np.random.default_rng(1)
    angle = 0.2 * np.arange(20)
    turn = np.zeros((20, 3, 3))
    turn[:, 0, 0], turn[:, 0, 2], turn[:, 1, 1] = np.cos(angle), np.sin(angle), 1
    turn[:, 2, 0], turn[:, 2, 2] = -np.sin(angle), np.cos(angle)
    return from_one_view(factorise_tracks((turn @ rng.normal(size=(3, 12)))[:, :2]))


def test_a_partial_result_is_inserted_among_all_frames_and_points(found):
    frames, points = np.ones(22, bool), np.ones(13, bool)
    frames[[0, 5]], points[2] = False, False
    wide = expanded(found, frames, points)
    np.testing.assert_array_equal(wide.shape[np.ix_(frames, np.arange(3), points)], found.shape)
    assert np.isnan(wide.shape[0]).all()
    assert np.isnan(wide.shape[:, :, 2]).all()
    assert np.flatnonzero(~wide.answered).tolist() == [0, 5]
    assert not wide.predicted[0].any()
    assert expanded(found, np.ones(20, bool), np.ones(12, bool)) is found


def test_a_known_distance_sets_the_scale_and_replaces_its_gauge(found):
    scaled = with_known_distance(found, 0, 3, 0.25)
    apart = np.linalg.norm(found.shape[:, :, 0] - found.shape[:, :, 3], axis=1)
    assert np.median(apart) * scaled.metres_per_unit == pytest.approx(0.25)
    assert scaled.metres_per_unit_sd < 1e-3 * scaled.metres_per_unit
    assert sum(line.startswith("Scale") for line in scaled.gauge) == 1


@pytest.mark.parametrize("given", [(0, 0, 1.0), (0, 12, 1.0), (-1, 2, 1.0), (0, 1, 0.0), (0, 1, np.nan)])
def test_an_impossible_distance_is_an_error(found, given):
    with pytest.raises(MareyError):
        with_known_distance(found, *given)


def test_a_held_size_changes_only_the_images():
    rng = np.random.default_rng(2)
    frames, points = 5, 4
    basis, coefficients = rng.normal(size=(2, 3, points)), np.stack([np.ones(frames), rng.normal(size=frames)], 1)
    turns = rotations.exp(rng.normal(size=(frames, 3)))
    shapes = ManyViewShapes(
        shape=np.einsum("fk,kip->fip", coefficients, basis), shape_sd=np.ones((frames, 3, points)), rotation=turns,
        rotation_sd=np.ones((frames, 3)), camera_from_first=rotations.exp(np.array([[0, 0, 0], [0, 0.5, 0]])),
        camera_sd=np.zeros((2, 3)), scale=np.array([1, 1.2]), translation=rng.normal(size=(2, frames, 2)), basis=basis,
        coefficients=coefficients, noise_sd=np.ones(2), residuals=np.ones((2, frames, points)),
        predicted=np.zeros((frames, points), bool), notes=(),
    )  # fmt: skip
    size = np.array([0.8, 0.9, 1.0, 1.1, 1.2])
    found = from_held_size(HeldSizeShapes(shapes=shapes, magnification=size))
    np.testing.assert_allclose(found.shape, shapes.shape)
    np.testing.assert_allclose(found.modelled, from_many_views(shapes).modelled * size[:, None, None])
    np.testing.assert_allclose(found.residuals, np.broadcast_to(size[:, None], (2, frames, points)))
    cameras = found.cameras
    turned = np.einsum("cij,fjp->cfip", cameras.camera_from_first, found.rotation @ found.shape)[:, :, :2]
    shown = cameras.magnification[:, None, None] * cameras.scale[:, None, None, None] * turned
    np.testing.assert_allclose(shown + cameras.translation[..., None], found.modelled)
    assert "0.80 to 1.20 times" in found.notes[0]
    wide = expanded(found, np.array([True] * 5 + [False]), np.ones(points, bool))
    assert np.array_equal(np.isfinite(wide.cameras.magnification), [True] * 5 + [False])
