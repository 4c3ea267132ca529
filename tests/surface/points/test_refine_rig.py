from dataclasses import replace

import numpy as np
import pytest
from tests import scenes

from marey.cameras.rig import Rig
from marey.errors import SettingProblem
from marey.geometry.rigid import RigidTransform
from marey.surface.points.refine_rig import Sighting, refine_rig
from marey.surface.points.settings import RigRefinementSettings

TRUE = scenes.rig(-15, 0, 15)


def sighting(rng, *, count=400, noise=0.1, cameras=TRUE):
    points = rng.uniform(-0.22, 0.22, (count, 3))
    pixels = np.stack([camera.project(points) for camera in cameras], axis=1) + rng.normal(0, noise, (count, 3, 2))
    return Sighting(pixels=pixels, sigma=np.full((count, 3), noise))


def turned(camera, degrees, axis=(1.0, 0, 0)):
    turn = RigidTransform.from_vector(np.radians(degrees) * np.array(axis), np.zeros(3))
    return replace(camera, camera_from_world=turn @ camera.camera_from_world)


def test_a_camera_that_nods_is_found(rng):
    given = Rig((TRUE.cameras[0], TRUE.cameras[1], turned(TRUE.cameras[2], 0.1)))
    found = refine_rig(given, [sighting(rng)], fixed=1)
    assert found.significant
    assert found.residual_before > 0.2
    # Three views of a point with 0.1 px in each axis leave three of six residuals.
    assert found.residual_after == pytest.approx(0.1 * np.sqrt(2.37 / 3), rel=0.15)
    assert np.degrees(found.rotation[2]) == pytest.approx(0.1, abs=0.03)
    assert found.rotation[1] == 0
    baseline = [np.linalg.norm(rig.centres[0] - rig.centres[1]) for rig in (given, found.rig)]
    assert baseline[1] == pytest.approx(baseline[0], rel=1e-5)


def test_true_cameras_are_left_alone(rng):
    found = refine_rig(TRUE, [sighting(rng)], fixed=1)
    assert not found.significant
    assert np.degrees(found.rotation).max() < 0.05
    assert found.moved_px.max() < 0.2


def test_an_instant_at_which_the_cameras_were_not_exposed_together_hardly_counts(rng):
    given = Rig((TRUE.cameras[0], TRUE.cameras[1], turned(TRUE.cameras[2], 0.1)))
    good = [sighting(rng) for _ in range(2)]
    late = sighting(rng)
    pixels = np.array(late.pixels)
    pixels[:, 2, 1] += rng.normal(4, 3, len(pixels))
    found = refine_rig(given, [*good, Sighting(pixels=pixels, sigma=late.sigma)], fixed=1)
    alone = refine_rig(given, good, fixed=1)
    assert np.degrees(abs(found.rotation[2] - alone.rotation[2])) < 0.02


def test_the_settings_decide_what_is_significant_and_how_many_matches_are_needed(rng):
    given = Rig((TRUE.cameras[0], TRUE.cameras[1], turned(TRUE.cameras[2], 0.1)))
    seen = [sighting(rng)]
    assert not refine_rig(given, seen, fixed=1, settings=RigRefinementSettings(significant_px=5.0)).significant
    assert refine_rig(given, seen, fixed=1, settings=RigRefinementSettings(least_matches=500)) is None


def test_too_few_matches_give_no_correction(rng):
    assert refine_rig(TRUE, [sighting(rng, count=20)], fixed=1) is None
    assert refine_rig(TRUE, [], fixed=1) is None
    with pytest.raises(SettingProblem, match="fixed camera is 5"):
        refine_rig(TRUE, [sighting(rng)], fixed=5)
