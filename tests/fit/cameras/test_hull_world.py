"""A first world from the silhouettes of a made figure, before cameras in any axes and unit."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from tests.made_boards import made_rig

from marey.arrays import Mask
from marey.cameras.camera import Camera
from marey.fit.cameras.hull_world import LEAST_HULLS, HullWorld, hull_world
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform

UNIT, AXES = 37.0, RigidTransform(rotations.exp(np.array([0.8, -0.9, 0.5])), np.array([1.0, -2.0, 0.7]))
"""The unit and axes of the given calibration: per metre, and from the world."""
HEIGHT = 1.7


def silhouettes(cameras: tuple[Camera, ...], half_axes: tuple[float, float, float]) -> list[list[Mask]]:
    """Silhouettes of an ellipsoid that stands on the floor and moves along y."""
    rng = np.random.default_rng(1)
    points = rng.normal(size=(2000, 3))
    points *= np.array(half_axes) / np.linalg.norm(points, axis=1, keepdims=True)
    pictures = []
    for k in range(LEAST_HULLS):
        masks = []
        for camera in cameras:
            pixels = camera.project(points + [0.0, 0.05 * k, half_axes[2]])
            drawn = np.zeros((camera.height, camera.width), np.uint8)
            cv2.fillConvexPoly(drawn, cv2.convexHull(np.round(pixels).astype(np.int32)), 1)
            masks.append(drawn > 0)
        pictures.append(masks)
    return pictures


def found_world(half_axes: tuple[float, float, float]) -> HullWorld | None:
    true = tuple(camera.scaled(0.25) for camera in made_rig(4, np.random.default_rng(3)))
    moved = [camera.moved(AXES).camera_from_world for camera in true]
    given = [
        replace(camera, camera_from_world=RigidTransform(pose.rotation, UNIT * pose.translation))
        for camera, pose in zip(true, moved, strict=True)
    ]
    return hull_world(given, silhouettes(true, half_axes))


def test_up_floor_and_height_of_a_figure_are_found_in_any_axes_and_unit():
    found = found_world((0.25, 0.18, HEIGHT / 2))
    assert found is not None
    up = found.world_from_given.rotation @ AXES.rotation[:, 2]
    # The cells are 5 cm; a body between four cameras has corners that its silhouettes do not show.
    assert np.degrees(np.arccos(up[2])) < 3.0
    # Each end has 0.5 % of the cells, the volume of a cap of 8.3 % of half the height.
    assert found.height / UNIT == pytest.approx((1 - 0.083) * HEIGHT, abs=0.05)
    floor = found.world_from_given.apply(UNIT * AXES.translation)[2] / UNIT
    assert floor == pytest.approx(0.0, abs=0.1)


def test_no_up_is_found_of_a_figure_that_is_not_upright():
    assert found_world((0.5, 0.5, 0.5)) is None


def test_no_world_is_found_without_common_silhouettes():
    cameras = tuple(camera.scaled(0.25) for camera in made_rig(4, np.random.default_rng(3)))
    empty = [[np.zeros((camera.height, camera.width), bool) for camera in cameras]] * LEAST_HULLS
    assert hull_world(cameras, empty) is None
