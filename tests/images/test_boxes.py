"""The part of an image about a region."""

import numpy as np

from marey.images.boxes import box_about


def test_a_box_holds_the_region_and_its_margin():
    region = np.zeros((40, 60), bool)
    region[10:12, 20], region[15, 30] = True, True
    assert box_about(region, 3.2) == (slice(6, 20), slice(16, 35))
    assert region[box_about(region, 0)].shape == (6, 11)


def test_a_box_ends_at_the_border_of_the_image():
    region = np.zeros((5, 4), bool)
    region[0, 3] = True
    part = np.ones((5, 4))[box_about(region, 2)]
    assert part.shape == (3, 3)
