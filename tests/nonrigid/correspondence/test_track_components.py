import numpy as np
from tests.nonrigid.filmed_surfaces import CAMERAS, filmed, moving_surface

from marey.nonrigid.correspondence.track_components import components, full_frames, points_move, prepared


def tracks_of(seed=0, noise=0.0):
    random = np.random.default_rng(seed)
    return filmed(moving_surface(random), CAMERAS[1], scale=30, noise=noise, random=random)


def test_prepared_tracks_are_centred_and_of_unit_spread():
    made = prepared(tracks_of())
    np.testing.assert_allclose(made.mean(axis=2), 0, atol=1e-12)
    np.testing.assert_allclose(np.mean(np.sum(made**2, axis=1)), 1)


def test_gaps_are_filled_by_the_low_rank():
    tracks = tracks_of()
    gappy = tracks.copy()
    gappy[10:20, :, 3] = np.nan
    np.testing.assert_allclose(prepared(gappy)[10:20, :, 3], prepared(tracks)[10:20, :, 3], atol=0.02)


def test_noise_alone_does_not_count_as_motion():
    still = np.repeat(tracks_of()[:1], 60, axis=0)
    noisy = still + 0.5 * np.random.default_rng(1).normal(size=still.shape)
    assert not points_move(prepared(noisy))
    assert not points_move(prepared(still))
    assert points_move(prepared(tracks_of(noise=0.5)))


def test_components_keep_distances_between_tracks():
    first, second = prepared(tracks_of()), prepared(tracks_of(1))
    few, _ = components(first, second)
    whole = np.sum((first[..., 0] - first[..., 1]) ** 2) / len(first)
    np.testing.assert_allclose(np.sum((few[..., 0] - few[..., 1]) ** 2), whole, rtol=1e-6)


def test_frames_with_few_points_are_found():
    tracks = tracks_of()
    tracks[5, :, 4:] = np.nan
    assert np.flatnonzero(~full_frames(tracks)).tolist() == [5]
