import numpy as np
import pytest

from marey.view.pictures.people_picture import draw_people


@pytest.mark.parametrize("channels", [1, 3])
def test_everybody_gets_a_box_with_a_number_of_another_colour(channels):
    image = np.full((120, 160, channels), 100, np.uint8)
    points = np.array([[40.0, 30.0], [60.0, 90.0]])
    drawn = draw_people(image, [(1, points), (2, points + [60, 5])])
    assert drawn.shape == (120, 160, 3)
    assert (image == 100).all()
    changed = (drawn != 100).any(axis=2)
    assert changed[:, 30:70].any()
    assert changed[:, 90:130].any()
    assert not changed[:, 140:].any()
    assert not (drawn[60, 34:42] == drawn[60, 94:102]).all()


def test_who_is_not_in_the_image_is_not_drawn():
    image = np.zeros((20, 20, 3), np.uint8)
    assert (draw_people(image, [(1, np.zeros((0, 2)))]) == image).all()
