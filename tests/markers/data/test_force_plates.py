import numpy as np

from marey.markers.data.force_plates import ForcePlate

CORNERS = np.array([[0.0, 0, 0], [0, 0.6, 0], [1.2, 0.6, 0], [1.2, 0, 0]])


def test_a_plates_frame_lies_in_the_middle_of_its_corners():
    plate = ForcePlate(name="p", corners=CORNERS, rate=100.0, force=np.zeros((0, 3)), moment=np.zeros((0, 3)))
    frame = plate.laboratory_from_plate
    np.testing.assert_allclose(frame.translation, [0.6, 0.3, 0])
    np.testing.assert_allclose(frame.rotation, [[0, -1, 0], [-1, 0, 0], [0, 0, -1]])


def test_the_centre_of_pressure_is_where_the_force_acts():
    at, force = np.array([0.9, 0.2, 0.0]), np.array([[30.0, -10.0, 700.0], [0, 0, 5.0]])
    middle = CORNERS.mean(0)
    plate = ForcePlate(name="p", corners=CORNERS, rate=100.0, force=force, moment=np.cross(at - middle, force))
    np.testing.assert_allclose(plate.centre_of_pressure[0], at, atol=1e-12)
    assert np.isnan(plate.centre_of_pressure[1]).all()  # 5 N do not determine a position
    np.testing.assert_allclose(plate.vertical, [700, 5])
