"""Bones of a standing person: exchanged sides of the pelvis and the legs, and the vertical axis."""

from dataclasses import replace

import numpy as np
import pytest

from marey.markers.preprocessing.own_frames import BonesAndMarkers
from marey.pipelines.causes.marker_postures import standing_reasons

# Bones: X forward, Y up, Z to the right; laboratory: X forward, Z up.
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
SEGMENTS = ("pelvis", "left_thigh", "right_thigh")
ORIGINS = np.array([[0, 0, 1.0], [0, 0.1, 0.9], [0, -0.1, 0.9]])


@pytest.fixture
def bones() -> BonesAndMarkers:
    return BonesAndMarkers(
        segments=SEGMENTS, rotation=np.stack([UPRIGHT] * 3), origin=ORIGINS, labels=(), points=np.zeros((0, 3))
    )


def texts(bones: BonesAndMarkers, *, y_up: bool = False) -> list[str]:
    return [reason.what for reason in standing_reasons("static.c3d", bones, y_up=y_up)]


def test_an_upright_person_is_sound(bones):
    assert texts(bones) == []


def test_another_vertical_axis_is_named(bones):
    [text] = texts(bones, y_up=True)
    assert "stands along Z of the laboratory, 90 degrees from Y" in text


def test_a_pelvis_with_exchanged_sides_is_upside_down(bones):
    rotation = np.array(bones.rotation)
    rotation[0] = UPRIGHT @ np.diag([1.0, -1.0, -1.0])
    found = texts(replace(bones, rotation=rotation))
    assert "The pelvis in static.c3d is upside down" in found[0]


def test_exchanged_legs_are_named(bones):
    [text] = texts(replace(bones, origin=ORIGINS * [1, -1, 1]))
    assert "the left thigh is on the right of the pelvis" in text


def test_thighs_without_a_pelvis_have_no_sides(bones):
    legs = replace(bones, segments=SEGMENTS[1:], rotation=bones.rotation[1:], origin=(ORIGINS * [1, -1, 1])[1:])
    assert texts(legs) == []
