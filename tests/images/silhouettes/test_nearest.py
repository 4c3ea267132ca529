"""The nearest pixel is found without a search over all pixels."""

import numpy as np
import pytest

from marey.images.silhouettes.nearest import nearest_within, sort_into_cells


@pytest.mark.parametrize("reach", [0.0, 3.0, 8.0, 25.0, 200.0])
def test_the_nearest_pixel_within_reach_is_found(rng, reach):
    pixels = rng.integers(-20, 90, (60, 2)).astype(float)
    cells = sort_into_cells(pixels)
    places = np.concatenate([rng.integers(-60, 130, (300, 2)).astype(float), rng.uniform(-60, 130, (300, 2)), pixels])
    for place in places:
        distance = np.linalg.norm(pixels - place, axis=1)
        found = nearest_within(cells, place[0], place[1], reach)
        if distance.min() > reach:
            assert found == -1
        else:
            assert distance[found] == pytest.approx(distance.min(), abs=1e-12)


def test_among_no_pixels_none_is_nearest():
    assert nearest_within(sort_into_cells(np.zeros((0, 2))), 1.0, 2.0, 30.0) == -1
