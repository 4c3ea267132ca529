"""Pictures that contradict the calibration: the cause whose repair explains their matches."""

from dataclasses import replace

import numpy as np
import pytest
from tests import scenes

from marey.cameras.rig import Rig
from marey.pipelines.causes.pictures import PicturesOfInstant, picture_reasons

RIG = Rig(
    tuple(
        scenes.camera_at(name, angle, height=height)
        for name, angle, height in (("left", -9, 0.05), ("middle", 0, 0.13), ("right", 11, -0.02))
    )
)
PAIRS = [(0, 1), (1, 2)]


@pytest.fixture(scope="module")
def instants() -> list[list[np.ndarray]]:
    rng = np.random.default_rng(5)
    return [scenes.films(RIG, rng) for _ in range(2)]


def cause(images, *, rig=RIG, others=None, suspicious=True):
    shown = PicturesOfInstant(rig=rig, images=images, pairs=PAIRS, others=others or {})
    return picture_reasons(shown, suspicious=suspicious)


def flipped(image):
    return np.ascontiguousarray(image[:, ::-1])


@pytest.mark.slow
def test_sound_pictures_have_no_cause(instants):
    assert cause(instants[0], others={1: lambda: instants[1]}) == ()
    assert cause(instants[0], suspicious=False) == ()


@pytest.mark.slow
@pytest.mark.parametrize("order", [(1, 0, 2), (2, 1, 0), (1, 2, 0)])
def test_exchanged_pictures_are_named_even_if_the_points_seem_sound(instants, order):
    (reason,) = cause([instants[0][i] for i in order], suspicious=False)
    assert reason.cause == "exchanged"
    assert reason.cameras == tuple(name for i, name in zip(order, RIG.names, strict=True) if RIG.names[i] != name)
    for given, wanted in zip(RIG.names, order, strict=True):
        if RIG.names[wanted] != given:
            assert f"{given} shows what {RIG.names[wanted]} should" in reason.remedy
    assert "matches of keypoints are near their epipolar lines, instead of" in reason.what


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mirrored", "upside down"])
def test_a_flipped_picture_is_named(instants, kind):
    left, middle, right = instants[0]
    wrong = flipped(right) if kind == "mirrored" else np.ascontiguousarray(right[::-1, ::-1])
    (reason,) = cause([left, middle, wrong])
    assert (reason.cause, reason.cameras) == (kind, ("right",))


@pytest.mark.slow
def test_mirror_images_of_all_cameras_are_named(instants):
    (reason,) = cause([flipped(image) for image in instants[0]])
    assert (reason.cause, reason.cameras) == ("mirrored", RIG.names)


@pytest.mark.slow
def test_a_picture_of_another_instant_is_named_with_the_way_to_it(instants):
    left, middle, right = instants[0]
    late = [left, middle, instants[1][2]]
    (reason,) = cause(late, others={-1: lambda: instants[1], 1: lambda: [instants[1][0], middle, right]})
    assert (reason.cause, reason.cameras) == ("late", ("right",))
    assert "those 1 frame later belong to the others" in reason.what


@pytest.mark.slow
def test_a_calibration_for_another_size_is_named(instants):
    half = Rig(tuple(replace(camera.scaled(0.5), size=camera.size) for camera in RIG))
    (reason,) = cause(instants[0], rig=half)
    assert (reason.cause, reason.cameras) == ("image size", RIG.names)
    assert "0.5 times as large" in reason.what


@pytest.mark.slow
def test_cameras_in_a_symmetric_row_do_not_decide_between_two_causes(rng):
    row = scenes.rig(-10, 0, 10)
    (reason,) = cause([flipped(image) for image in scenes.films(row, rng)], rig=row)
    assert "exchanged" in reason.what
    assert ", or " in reason.what
    assert "mirror images" in reason.what


@pytest.mark.slow
def test_pictures_of_different_objects_have_no_known_cause(rng):
    assert cause([scenes.Ball.draw(rng).filmed(camera, rng) for camera in RIG]) == ()
