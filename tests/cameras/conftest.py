"""What the tests of cameras share."""

from collections.abc import Callable

import numpy as np
import pytest

from marey.cameras.camera import Camera
from marey.geometry.rigid import RigidTransform


@pytest.fixture
def make_camera() -> Callable[..., Camera]:
    def make(**changes) -> Camera:
        values = {
            "name": "cam01",
            "size": (640, 480),
            "matrix": np.array([[600.0, 0, 322], [0, 595, 236], [0, 0, 1]]),
            "distortion": np.array([-0.3, 0.12, 1e-3, -2e-3]),
            "camera_from_world": RigidTransform.from_vector(np.array([1.6, 0.7, -0.5]), np.array([0.2, 0.8, 4.0])),
        }
        return Camera(**(values | changes))

    return make
