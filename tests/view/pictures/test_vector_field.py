import numpy as np
from tests.worlds import looking_at

from marey.view.pictures.vector_field import speed_colours, vector_field

CAMERA = looking_at(np.zeros(3), np.array([0.0, -2.0, 0.0]), size=(200, 160), focal=300.0)


def test_each_line_runs_from_the_point_to_where_it_goes():
    picture = np.zeros((160, 200, 3), np.uint8)
    drawn = vector_field(picture, CAMERA, np.array([[0.1, 0.0, 0.2]]), np.array([[1.0, 0.0, 0.0]]), seconds=0.2)
    x, y = CAMERA.project(np.array([0.2, 0.0, 0.2]))
    assert drawn[round(y), round(x)].max() > 100
    assert drawn[round(y) + 6, round(x)].max() == 0


def test_unknown_points_and_points_outside_are_left_out():
    picture = np.full((160, 200, 3), 100, np.uint8)
    position = np.array([[np.nan, 0, 0], [0.0, 0, 0], [9.0, 0, 0], [0.0, -5.0, 0]])
    velocity = np.array([[1.0, 0, 0], [np.nan, 0, 0], [1.0, 0, 0], [1.0, 0, 0]])
    drawn = vector_field(picture, CAMERA, position, velocity, seconds=0.1)
    np.testing.assert_array_equal(drawn, np.full_like(picture, 55))


def test_faster_is_brighter():
    brightness = speed_colours(np.linspace(0, 1, 6)).astype(float) @ [0.11, 0.59, 0.3]
    assert (np.diff(brightness) > 0).all()
