import numpy as np
from tests.nonrigid.filmed_surfaces import CAMERAS, filmed, moving_surface

from marey.nonrigid.correspondence.view_evidence import PairTracks, pair_evidence


def evidence(surface, noise, pairs):
    random = np.random.default_rng(3)
    views = [filmed(surface, camera, noise=noise, random=random) for camera in CAMERAS[:2]]
    few = [(view - view.mean(2, keepdims=True))[::4] for view in views]
    return pair_evidence(PairTracks(*few, np.arange(pairs), np.arange(pairs)))


def test_true_pairs_have_the_largest_evidence_even_if_not_given():
    score = evidence(moving_surface(np.random.default_rng(0), points=30), 0.005, 20)
    assert np.diag(score).min() > 5
    assert np.array_equal(score.argmax(axis=1), np.arange(30))


def test_noise_weakens_the_evidence():
    surface = moving_surface(np.random.default_rng(0), points=30)
    strong, weak = (np.median(np.diag(evidence(surface, noise, 30))) for noise in (0.005, 0.1))
    assert 0 < weak < 0.6 * strong
