"""Where other people are in the images: those of all cameras, of one camera, and doubles of the followed person."""

import numpy as np
import pytest
from tests import worlds
from tests.detected import JOINTS, detections

from marey.body.articulation.pose import PosedBody
from marey.fit.recipes.other_people import other_figures
from marey.fit.recipes.seen_people import find_people

CAMERAS = worlds.ring(3, size=(400, 240))
COUNT = 9
LEFT, RIGHT = (JOINTS.index("left_wrist"), JOINTS.index("right_wrist"))


def person(at, frames):
    body = worlds.person()
    return [PosedBody(body, worlds.pose(body, at=(*at, 0))) if f in frames else None for f in range(COUNT)]


def figures_of(pixels, sure):
    tracks = find_people(CAMERAS, pixels, sure, rate=worlds.RATE)
    return other_figures(CAMERAS, JOINTS, pixels, sure, tracks, tracks[0], rate=worlds.RATE)


def test_a_second_person_is_in_every_image_also_where_the_detector_missed_it():
    pixels, sure = detections([person((0.4, 0.0), range(COUNT)), person((-0.6, 0.3), range(2, 7))], CAMERAS)
    missed = pixels.copy()
    missed[3, 1, 1] = missed[4, :, 1] = np.nan
    figures = figures_of(missed, sure)
    assert set(figures) == {(frame, c) for frame in range(2, 7) for c in range(3)}
    for frame, c in figures:
        [figure] = figures[frame, c]
        np.testing.assert_allclose(figure.pixels, pixels[frame, c, 1], atol=0.5)
        true = np.linalg.norm(np.array([-0.6, 0.3, 0.0]) - CAMERAS[c].centre)
        assert figure.distance_m == pytest.approx(true, rel=0.06)


def test_one_that_a_single_camera_detects_is_drawn_there_and_across_gaps():
    pixels, sure = detections([person((0.4, 0.0), range(COUNT)), person((-0.6, 0.3), range(2, 7))], CAMERAS)
    pixels[:, [0, 2], 1] = np.nan
    true, pixels[4, 1, 1] = pixels[4, 1, 1].copy(), np.nan
    figures = figures_of(pixels, sure)
    assert set(figures) == {(frame, 1) for frame in range(2, 7)}
    np.testing.assert_allclose(figures[4, 1][0].pixels, true, atol=0.5)


def test_the_followed_person_with_exchanged_sides_is_nobody_else():
    pixels, sure = detections([person((0.4, 0.0), range(COUNT))], CAMERAS)
    mirrored = [JOINTS.index(n.replace("left", "x").replace("right", "left").replace("x", "right")) for n in JOINTS]
    pixels[5, 1, 0] = pixels[5, 1, 0][mirrored] + 3.0
    double = np.concatenate(
        [pixels, np.where(np.arange(COUNT)[:, None, None, None, None] > 2, pixels + 2.0, np.nan)], 2
    )
    assert figures_of(pixels, sure) == {}
    assert figures_of(double, np.concatenate([sure, sure], 2)) == {}


def test_somebody_with_few_joints_is_not_drawn():
    pixels, sure = detections([person((0.4, 0.0), range(COUNT)), person((-0.6, 0.3), range(COUNT))], CAMERAS)
    pixels[:, :, 1, :13] = np.nan
    assert figures_of(pixels, sure) == {}
