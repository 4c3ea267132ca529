"""The plain method: exact for rigid objects, with errors for unsuitable tracks."""

import numpy as np
import pytest

from marey.errors import MareyError
from marey.geometry import rotations
from marey.nonrigid.one_camera.plain import factorise_plainly


def test_a_rigid_object_is_found_exactly(rng):
    path, shape = rotations.exp(np.cumsum(0.1 * rng.normal(size=(60, 3)), 0)), rng.normal(size=(3, 12))
    tracks = (path @ shape)[:, :2] + rng.normal(size=(60, 2, 1))
    found = factorise_plainly(tracks, 1)
    fit = (found.rotation @ found.shape)[:, :2] + found.translation[:, :, None]
    np.testing.assert_allclose(fit, tracks, atol=1e-9)
    centred = shape - shape.mean(1, keepdims=True)
    lengths = np.linalg.norm(centred[:, :, None] - centred[:, None], axis=0)
    np.testing.assert_allclose(np.linalg.norm(found.shape[5][:, :, None] - found.shape[5][:, None], axis=0), lengths)
    assert found.rank == 1


def test_results_with_more_basis_shapes_are_consistent(rng):
    found = factorise_plainly(rng.normal(size=(30, 2, 12)), 3)
    assert (found.basis.shape, found.coefficients.shape) == ((3, 3, 12), (30, 3))
    np.testing.assert_allclose(np.einsum("fk,kip->fip", found.coefficients, found.basis), found.shape)
    np.testing.assert_allclose(
        found.rotation @ np.swapaxes(found.rotation, 1, 2), np.tile(np.eye(3), (30, 1, 1)), atol=1e-9
    )


def test_gaps_and_impossible_ranks_are_an_error(rng):
    tracks = rng.normal(size=(30, 2, 12))
    with pytest.raises(MareyError, match="suit"):
        factorise_plainly(tracks, 5)
    tracks[0, :, 0] = np.nan
    with pytest.raises(MareyError, match="complete"):
        factorise_plainly(tracks, 2)
