"""Whether refined cameras differ from the given ones by more than their standard deviations."""

import numpy as np
import pytest
from tests import scenes

from marey.cameras.parameters import LENS_PARAMETERS, PARAMETERS, stepped_camera
from marey.pipelines.from_person.camera_changes import camera_changes

CAMERAS = tuple(scenes.rig(-10, 0, 10))


def covariance(rng):
    """A covariance of the poses of all cameras, which no person determines in seven directions; lenses are known."""
    poses = (PARAMETERS * np.arange(3)[:, None] + np.arange(LENS_PARAMETERS, PARAMETERS)).ravel()
    root = rng.normal(size=(18, 11)) * 1e-3
    full = np.zeros((45, 45))
    full[np.ix_(poses, poses)] = root @ root.T
    return full, root, poses


def moved(step):
    return tuple(stepped_camera(camera, own) for camera, own in zip(CAMERAS, step.reshape(3, PARAMETERS), strict=True))


def step_of(root, poses, unit):
    step = np.zeros(45)
    step[poses] = root @ unit
    return step


def test_a_change_is_counted_in_standard_deviations_of_the_directions_that_were_estimated(rng):
    full, root, poses = covariance(rng)
    unit = rng.normal(size=11)
    found = camera_changes(CAMERAS, moved(step_of(root, poses, unit)), full)
    assert found.degrees_of_freedom == 11
    assert found.chi_square == pytest.approx(unit @ unit, rel=1e-3)


def test_changes_that_the_noise_explains_keep_the_given_cameras(rng):
    full, root, poses = covariance(rng)
    draws = [camera_changes(CAMERAS, moved(step_of(root, poses, rng.normal(size=11))), full) for _ in range(200)]
    # One in a thousand by chance.
    assert sum(each.significant for each in draws) <= 3
    # Every probability is as frequent as another.
    assert np.mean([each.probability for each in draws]) == pytest.approx(0.5, abs=0.08)
    kept = next(each for each in draws if not each.significant)
    assert kept.finding()["code"] == "keep-given-cameras"
    assert kept.finding()["advice"].startswith("Keep the given cameras")
    assert kept.finding()["severity"] == "note"


def test_a_camera_that_was_moved_is_named_and_the_new_ones_are_to_be_used(rng):
    full, root, poses = covariance(rng)
    step = step_of(root, poses, rng.normal(size=11))
    step[PARAMETERS + 12] += 0.05
    found = camera_changes(CAMERAS, moved(step), full)
    assert found.significant
    assert found.most == CAMERAS[1].name
    assert "probability below 0.001" in found.finding()["text"]
    assert found.finding()["advice"] == "Use the new cameras."


def test_cameras_that_were_not_estimated_are_kept():
    found = camera_changes(CAMERAS, CAMERAS, np.zeros((45, 45)))
    assert (found.degrees_of_freedom, found.probability, found.significant) == (0, 1.0, False)
