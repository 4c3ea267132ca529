"""The world of turned cameras from the silhouettes of the example alone."""

from dataclasses import replace

import numpy as np
import pytest
from tests.pipelines.capture.reach import EXAMPLE, copy_half_trial

import marey
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.people.person import person_body, stature
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.fit.recipes import person
from marey.fit.search.search import StartSettings
from marey.fit.search.start import find_both_ways
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.io.calibration.covariance import read_camera_covariance
from marey.io.calibration.readers import read_rig, write_cameras_toml
from marey.pipelines.from_person.planted_world import planted_world
from marey.pipelines.from_person.silhouette_world import calibrate_person_world, captured_person

UNIT, AXES = 37.0, RigidTransform(rotations.exp(np.array([1.8, -1.4, 0.5])), np.array([1.0, -2.0, 0.7]))
"""The unit and axes of the given calibration: per metre, and from the world."""

QUICK = StartSettings(yaws=8, kept=2, finalists=1, arm_directions=16, leg_directions=12)
"""Extent of a search that suffices for the person of the example."""


def turned_trial(folder):
    """Copy the example with cameras in another unit and with other axes."""
    copy_half_trial(folder)
    cameras = []
    for camera in read_rig(folder / "cameras.toml"):
        pose = camera.moved(AXES).camera_from_world
        cameras.append(replace(camera, camera_from_world=RigidTransform(pose.rotation, UNIT * pose.translation)))
    write_cameras_toml(Rig(tuple(cameras)), folder / "cameras.toml")
    return folder


@pytest.mark.slow
def test_up_floor_and_scale_are_found_by_silhouettes_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(person, "find_both_ways", lambda *given: find_both_ways(*given[:4], QUICK))
    promising = person.promising_frames
    monkeypatch.setattr(person, "promising_frames", lambda take, count: promising(take, 1))
    folder, out = turned_trial(tmp_path / "reach"), tmp_path / "world"
    with marey.tuned_process():
        found = calibrate_person_world(folder, out=out, frames=(10, 34), stature=1.70)
    true = read_rig(EXAMPLE / "cameras.toml")
    turn = found.cameras.cameras[0].camera_from_world.rotation.T @ true.cameras[0].camera_from_world.rotation
    # The stated standard deviation is 1.4 degrees and 12 mm for the whole take.
    assert np.degrees(np.arccos(turn[2, 2])) < 3.0
    assert np.ptp(found.cameras.centres[:, 2] - true.centres[:, 2]) < 0.2
    assert np.mean(found.cameras.centres[:, 2] - true.centres[:, 2]) == pytest.approx(0.0, abs=0.06)
    apart, given = (np.linalg.norm(rig.centres[0] - rig.centres[2]) for rig in (found.cameras, true))
    assert apart == pytest.approx(given, rel=0.04)
    assert read_rig(out / "cameras.toml").names == true.names
    covariance = read_camera_covariance(out / "cameras.toml", found.cameras)
    assert covariance is not None
    assert np.trace(covariance) > 0


def test_a_trial_without_its_empty_room_is_refused(tmp_path):
    folder = turned_trial(tmp_path / "reach")
    (folder / "background" / "cam02.png").unlink()
    with pytest.raises(FileProblem, match="no image of the empty room, and no silhouettes, of cam02"):
        calibrate_person_world(folder, out=tmp_path / "world")


def test_results_beside_the_cameras_are_refused(tmp_path):
    folder = turned_trial(tmp_path / "reach")
    with pytest.raises(FileProblem, match="is the folder of the trial's cameras"):
        calibrate_person_world(folder, out=folder)


def test_a_body_at_rest_stands_on_the_lowest_points_of_its_feet():
    body = person_body("fine")
    rest = PosedBody(body, Pose(np.zeros(3), np.eye(3), np.zeros(len(body.skeleton) - 6)))
    person = captured_person(body, [rest] * 12, np.arange(12) / 30)
    world = planted_world(person)
    assert world is not None
    assert world.stances == 6
    # The soles are the lowest 12 mm of the feet, a few millimetres above the lowest point on average.
    floor = world.world_from_capture.apply(body.vertices)[:, 2]
    assert floor.min() == pytest.approx(0.0, abs=0.015)
    assert np.ptp(floor) == pytest.approx(stature(body)[0], abs=0.02)
