from typing import NamedTuple

import numpy as np
import pytest

from marey.nonrigid import held_size
from marey.nonrigid.held_size import magnifications


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


class Shapes(NamedTuple):
    """As much of an answer as is looked at."""

    shape: np.ndarray


@pytest.mark.parametrize("spread", [0.1, 1e-3])
def test_tracks_are_divided_by_magnifications_worth_the_name(monkeypatch, spread):
    random = np.random.default_rng(1)
    size = np.exp(spread * np.sin(np.arange(10)))
    size /= np.exp(np.log(size).mean())
    asked = []

    def factorise(tracks):
        asked.append(tracks)
        return Shapes(size[:, None, None] * mean)

    mean, tracks = random.normal(size=(3, 8)), random.normal(size=(2, 10, 2, 8))
    monkeypatch.setattr(held_size, "factorise_views", factorise)
    found = held_size.factorise_at_held_size(tracks)
    if spread == 0.1:
        np.testing.assert_allclose(found.magnification, size, rtol=1e-6)
        np.testing.assert_allclose(asked[1] * size[:, None, None], tracks)
    else:
        assert np.array_equal(found.magnification, np.ones(10))
        assert len(asked) == 1
