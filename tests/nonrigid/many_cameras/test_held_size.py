from dataclasses import dataclass

import numpy as np
import pytest

from marey.nonrigid.many_cameras import held_size
from marey.nonrigid.many_cameras.held_size import magnifications


def test_sizes_of_turned_and_shifted_shapes_are_found():
    random = np.random.default_rng(0)
    size = np.exp(random.normal(scale=0.1, size=12))
    size /= np.exp(np.log(size).mean())
    mean = random.normal(size=(3, 9))
    turns = np.linalg.qr(random.normal(size=(12, 3, 3)))[0]
    turns *= np.sign(np.linalg.det(turns))[:, None, None]
    shape = size[:, None, None] * (turns @ mean) + random.normal(size=(12, 3, 1))
    known = random.random((12, 9)) < 0.8
    known[:, :4] = True
    shape[:, :, 8] += np.where(known[:, 8], 0, 50.0)[:, None]
    np.testing.assert_allclose(magnifications(shape, known), size, rtol=1e-6)


@dataclass(frozen=True)
class Shapes:
    """The attributes of a result that are used."""

    shape: np.ndarray
    camera_from_first: np.ndarray
    camera_sd: np.ndarray
    scale: np.ndarray
    translation: np.ndarray
    noise_sd: np.ndarray
    residuals: np.ndarray


def answer(tracks, shape):
    count = len(tracks)
    return Shapes(
        shape,
        np.tile(np.eye(3), (count, 1, 1)),
        np.zeros((count, 3)),
        np.ones(count),
        np.zeros((count, 10, 2)),
        np.ones(count),
        np.zeros((count, 10, 8)),
    )


@pytest.mark.slow
@pytest.mark.parametrize("spread", [0.1, 1e-3])
def test_tracks_are_divided_by_magnifications_unless_they_are_negligible(monkeypatch, spread):
    random = np.random.default_rng(1)
    size = np.exp(spread * np.sin(np.arange(10)))
    size /= np.exp(np.log(size).mean())
    given = []

    def factorise(tracks, settings):
        given.append(tracks)
        return answer(tracks, size[:, None, None] * mean)

    mean, tracks = random.normal(size=(3, 8)), random.normal(size=(2, 10, 2, 8))
    monkeypatch.setattr(held_size, "factorise_views", factorise)
    found = held_size.factorise_at_held_size(tracks)
    if spread == 0.1:
        np.testing.assert_allclose(found.magnification, size, rtol=1e-6)
        np.testing.assert_allclose(given[1] * size[:, None, None], tracks)
    else:
        assert np.array_equal(found.magnification, np.ones(10))
        assert len(given) == 1


@pytest.mark.slow
def test_a_camera_that_shares_no_point_has_no_estimate(monkeypatch):
    random = np.random.default_rng(1)
    mean, tracks = random.normal(size=(3, 8)), random.normal(size=(3, 10, 2, 8))
    tracks[1] = np.nan
    monkeypatch.setattr(held_size, "factorise_views", lambda kept, settings: answer(kept, np.tile(mean, (10, 1, 1))))
    found = held_size.factorise_at_held_size(tracks).shapes
    assert np.array_equal(np.isfinite(found.scale), [True, False, True])
    assert np.array_equal(np.isfinite(found.residuals).all(axis=(1, 2)), [True, False, True])
