"""Figures of people in one image, beside the silhouettes of a body whose joints are known."""

import numpy as np
import pytest
from tests import worlds
from tests.detected import JOINTS, joints

from marey.body.articulation.pose import PosedBody
from marey.fit.recipes.person_figures import PersonFigure, draw_figures, figure_distance

CAMERAS = worlds.ring(4, size=(400, 480), focal=600.0)


def seen(degrees=worlds.ARMS_AND_KNEES):
    posed = PosedBody(worlds.person(), worlds.pose(worlds.person(), degrees))
    return posed, [camera.project(joints(posed)) for camera in CAMERAS]


@pytest.mark.parametrize("degrees", [worlds.ARMS_AND_KNEES, {}])
def test_a_figure_covers_the_body_and_little_more(degrees):
    posed, pixels = seen(degrees)
    for camera, of_camera in zip(CAMERAS, pixels, strict=True):
        away = float(np.linalg.norm(posed.segment_origin.mean(0) - camera.centre))
        drawn = draw_figures(camera, JOINTS, [PersonFigure(of_camera, away)])
        [body] = worlds.silhouettes(posed, [camera])
        assert np.count_nonzero(drawn & body) > 0.95 * np.count_nonzero(body)
        assert np.count_nonzero(drawn & body) > 0.6 * np.count_nonzero(drawn | body)


def test_a_margin_enlarges_a_figure():
    _, pixels = seen()
    figure = PersonFigure(pixels[0], 3.2)
    narrow, wide = (draw_figures(CAMERAS[0], JOINTS, [figure], margin_m=m) for m in (0.0, 0.05))
    assert (wide | narrow == wide).all()
    assert np.count_nonzero(wide) > 1.2 * np.count_nonzero(narrow)


def test_missing_joints_leave_out_their_limbs_only():
    _, pixels = seen()
    fewer = pixels[0].copy()
    fewer[[i for i, name in enumerate(JOINTS) if name.startswith("left_")]] = np.nan
    whole, part = (draw_figures(CAMERAS[0], JOINTS, [PersonFigure(p, 3.2)]) for p in (pixels[0], fewer))
    assert 0.2 < np.count_nonzero(part) / np.count_nonzero(whole) < 0.9


def test_nobody_is_an_empty_image():
    assert not draw_figures(CAMERAS[0], JOINTS, []).any()


def test_the_distance_follows_from_the_trunk_in_one_image():
    posed, pixels = seen()
    for camera, of_camera in zip(CAMERAS, pixels, strict=True):
        true = float(np.linalg.norm(posed.segment_origin.mean(0) - camera.centre))
        assert figure_distance(camera, JOINTS, of_camera) == pytest.approx(true, rel=0.15)


def test_without_a_trunk_the_legs_give_the_distance_and_a_head_alone_none():
    _, pixels = seen({})
    legs, head = np.full_like(pixels[0], np.nan), np.full_like(pixels[0], np.nan)
    for i, name in enumerate(JOINTS):
        if name.endswith(("hip", "knee", "ankle")):
            legs[i] = pixels[0][i]
        if name == "head":
            head[i] = pixels[0][i]
    assert figure_distance(CAMERAS[0], JOINTS, legs) == pytest.approx(3.2, rel=0.2)
    assert np.isnan(figure_distance(CAMERAS[0], JOINTS, head))
