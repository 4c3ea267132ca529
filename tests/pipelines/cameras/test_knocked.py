from dataclasses import replace

import numpy as np
import pytest
from tests import made_walk, worlds
from tests.fit.cameras.test_frontier import KNOCK, knocked

from marey.cameras.parameters import pose_basis
from marey.cameras.rig import Rig
from marey.pipelines.cameras.knocked import (
    LEAST_INSPECTED_FRAMES,
    CameraKnocked,
    displacement,
    displacement_sd,
    find_knocked,
)

FRAMES = 60


@pytest.fixture(scope="module")
def masks():
    cameras = made_walk.cameras()
    return made_walk.silhouettes(cameras, made_walk.clocks([0] * 4), frames=[FRAMES] * 4)


def inspected(masks, cameras, frames=FRAMES):
    return find_knocked(cameras, range(frames), lambda frame, camera: masks[camera][frame])


def test_nothing_is_found_among_cameras_in_their_places(masks):
    assert inspected(masks, made_walk.cameras()) is None


@pytest.mark.slow
@pytest.mark.parametrize("which", range(4))
def test_a_knocked_camera_is_named_and_found_again(masks, which):
    cameras = made_walk.cameras()
    found = inspected(masks, knocked(cameras, which))
    assert found.number == which
    turn_deg, _ = displacement(cameras[which], found.found.camera)
    assert turn_deg < 1.0
    assert found.contradiction_px > 2.0


def test_two_knocked_cameras_are_not_found_again(masks):
    assert inspected(masks, knocked(knocked(made_walk.cameras(), 0), 2, -KNOCK)) is None


def test_a_short_take_and_two_cameras_are_not_inspected(masks):
    bad = knocked(made_walk.cameras(), 1)
    assert inspected(masks, bad, LEAST_INSPECTED_FRAMES - 1) is None
    assert inspected(masks, bad[:2]) is None


@pytest.mark.slow
def test_the_next_run_has_the_found_camera_at_the_size_of_the_trial(masks):
    bad = knocked(made_walk.cameras(), 1)
    found = inspected(masks, bad)
    large = Rig(tuple(camera.scaled(2.0) for camera in bad))
    again = CameraKnocked(large, found)
    assert again.before is large.cameras[1]
    assert again.rig.cameras[1].size == large.cameras[1].size
    np.testing.assert_array_equal(again.rig.cameras[1].centre, found.found.camera.centre)
    assert again.rig.cameras[0] is large.cameras[0]
    assert "The silhouettes of cam02 contradict" in str(again)


def test_displacement_and_its_deviation_are_those_of_turn_and_centre():
    camera = worlds.ring()[0]
    sd = np.array([1e-3, 2e-3, 2e-3, 0.01, 0.02, 0.02])
    basis = pose_basis(camera)
    turn_sd_deg, shift_sd_mm = displacement_sd(camera, basis @ np.diag(sd**2) @ basis.T)
    np.testing.assert_allclose([turn_sd_deg, shift_sd_mm], [np.degrees(3e-3), 30.0])
    moved = knocked([camera], 0)[0]
    np.testing.assert_allclose(
        displacement(camera, moved), [np.degrees(np.linalg.norm(KNOCK[:3])), 1e3 * np.linalg.norm(KNOCK[3:])], rtol=0.05
    )
    assert displacement(camera, replace(camera, name="other")) == (0.0, 0.0)
