"""A sheet of images with names."""

import numpy as np
import pytest

from marey.view.pictures.contact_sheet import contact_sheet


@pytest.mark.parametrize(
    ("count", "shape"), [(1, (320, 480)), (2, (320, 960)), (3, (640, 960)), (4, (640, 960)), (5, (640, 1440))]
)
def test_every_image_has_its_place(count, shape):
    sizes = [(60, 80), (80, 60), (4, 400), (300, 2), (1000, 1000)]
    images = {f"Kamera {k} é": np.full((*sizes[k], 3), 60 + 40 * k, np.uint8) for k in range(count)}
    sheet = contact_sheet(images)
    assert sheet.shape == (*shape, 3)
    for k in range(count):
        assert np.any(np.all(sheet == 60 + 40 * k, axis=-1))
