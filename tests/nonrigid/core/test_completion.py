"""Completion of low-rank tracks with gaps."""

import numpy as np

from marey.nonrigid.core.completion import complete_tracks, singular_vectors


def test_missing_entries_of_low_rank_tracks_are_estimated(rng):
    tracks = np.einsum("fir,rp->fip", rng.normal(size=(120, 2, 4)), rng.normal(size=(4, 20)))
    tracks -= tracks.mean(2, keepdims=True)
    noisy = tracks + rng.normal(size=(120, 2, 1)) + 0.01 * rng.normal(size=tracks.shape)
    seen = rng.random((120, 20)) > 0.25
    found, noise = complete_tracks(np.where(seen[:, None], noisy, 1e6), seen, 4)
    assert 0.009 < noise < 0.011
    # 15 points per frame determine 5 numbers, so a fit is about as good as a measurement
    assert np.sqrt(np.mean((found - tracks) ** 2)) < 0.01
    np.testing.assert_allclose(found.mean(2), 0, atol=1e-12)


def test_singular_vectors_reconstruct_the_matrix(rng):
    for matrix in (rng.normal(size=(7, 4)), np.outer(np.arange(5.0), np.ones(9))):
        u, d, vt = singular_vectors(matrix)
        np.testing.assert_allclose((u * d) @ vt, matrix, atol=1e-12)
        np.testing.assert_allclose(d, np.linalg.svd(matrix, compute_uv=False), atol=1e-12)
        np.testing.assert_allclose(u.T @ u, np.eye(len(d)), atol=1e-12)
