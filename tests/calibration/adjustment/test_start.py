"""Groups of cameras that common pictures connect."""

import numpy as np
import pytest

from marey.calibration.adjustment.start import still_connected
from marey.calibration.boards.corners import BoardSighting, CornerSet


def seen(*views: tuple[int, int], cameras: int = 5) -> CornerSet:
    """One corner in each of several views, given as picture and camera."""
    sighting = BoardSighting(corner=np.array([0]), pixels=np.zeros((1, 2)), covariance=np.eye(2)[None])
    names = tuple(f"cam{k}" for k in range(cameras))
    return CornerSet.gather(names, ((64, 48),) * cameras, ("a", "b", "c", "d"), [(*view, sighting) for view in views])


@pytest.mark.parametrize(
    ("joined", "views", "expected"),
    [
        # Connected in a row; the last camera sees nothing.
        ([3, 3, 3, 3, 3], [(0, 0), (0, 1), (1, 1), (1, 2), (2, 2), (2, 3)], [3, 3, 3, 3, 3]),
        # Without the picture in the middle.
        ([3, 3, 3, 3, 4], [(0, 0), (0, 1), (1, 1), (2, 2), (2, 3)], [0, 0, 2, 2, 4]),
        # Cameras that were not connected stay so, whatever pictures they share.
        ([0, 0, 2, 2, 2], [(0, 0), (0, 1), (0, 2), (0, 3), (1, 3), (1, 4)], [0, 0, 2, 2, 2]),
        # A camera that shares no picture any more.
        ([1, 1, 1, 1, 1], [(0, 0), (0, 1), (0, 2), (0, 3), (1, 4)], [0, 0, 0, 0, 4]),
    ],
)
def test_cameras_stay_connected_by_common_pictures_alone(joined, views, expected):
    assert still_connected(np.array(joined), seen(*views)).tolist() == expected
