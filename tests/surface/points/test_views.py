import numpy as np
import pytest
from tests import scenes

from marey.surface.points.views import SurfaceView, TemplateSearch, comparisons, view_angles


def test_of_three_cameras_the_middle_one_is_the_template():
    assert comparisons(scenes.rig(-12, 0, 12), angle=0.7) == (TemplateSearch(1, (0, 2)),)
    assert comparisons(scenes.rig(0, 12, -12), angle=0.7) == (TemplateSearch(0, (1, 2)),)


def test_of_two_cameras_the_first_is_the_template_however_far_they_are_apart():
    assert comparisons(scenes.rig(0, 80), angle=0.7) == (TemplateSearch(0, (1,)),)


def test_cameras_all_around_all_take_part_with_their_neighbours():
    apart = 18
    found = comparisons(scenes.rig(*range(0, 360, apart)), angle=np.radians(25))
    assert {i for template, searched in found for i in (template, *searched)} == set(range(20))
    assert all((i - template) % 20 in (1, 19) for template, searched in found for i in searched)
    assert len(found) <= 10


def test_cameras_too_far_apart_are_not_compared():
    assert comparisons(scenes.rig(0, 90, 180, 270), angle=0.7) == ()


def test_angles_are_those_seen_from_the_middle_of_the_scene():
    angles = np.degrees(view_angles(scenes.rig(0, 10, 30)))
    assert angles[0, 1] == pytest.approx(10, abs=0.1)
    assert angles[1, 2] == pytest.approx(20, abs=0.1)


def test_a_mask_hides_pixels_and_so_does_the_border():
    camera = scenes.camera_at("a", 0)
    mask = np.zeros(camera.size[::-1], bool)
    mask[100:, :] = True
    view = SurfaceView(camera=camera, image=np.zeros((*mask.shape, 3), np.uint8), mask=mask)
    shown = view.shows(np.array([[50.0, 120.0], [50.0, 80.0], [-3.0, 120.0], [np.nan, 120.0]]))
    assert shown.tolist() == [True, False, False, False]


def test_a_smaller_view_hides_only_what_the_whole_mask_hides():
    camera = scenes.rig(0, 7).cameras[0]
    width, height = camera.size
    mask = np.zeros((height, width), bool)
    mask[100, 100] = mask[40:80, 60:90] = True
    small = SurfaceView(camera=camera, image=np.zeros((height, width, 3), np.uint8), mask=mask).scaled(0.5)
    np.testing.assert_array_equal(small.mask, mask.reshape(height // 2, 2, width // 2, 2).any(axis=(1, 3)))
