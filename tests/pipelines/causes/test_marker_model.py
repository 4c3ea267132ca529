"""Markers that are far from an OpenSim model: the cause whose repair fits."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from marey.body.articulation.jointed_body import JointedBody
from marey.geometry import rotations
from marey.io.markers.readers import read_markers
from marey.io.opensim.osim_model import read_osim_model
from marey.markers.data.trajectories import MarkerTrajectories
from marey.pipelines.causes.marker_model import lying_reasons, model_reasons


@cache
def model_and_trial(folder: Path) -> tuple[JointedBody, MarkerTrajectories]:
    walk = read_markers(folder / "walk.trc")
    few = slice(0, 120, 30)
    parts = {"points": walk.points[few], "filled": walk.filled[few], "residuals": walk.residuals[few]}
    return read_osim_model(folder / "model_scaled.osim"), replace(walk, **parts)


@pytest.fixture
def gait(shared) -> tuple[JointedBody, MarkerTrajectories]:
    return model_and_trial(shared / "data" / "markers" / "gait")


def cause(gait: tuple[JointedBody, MarkerTrajectories], points: np.ndarray) -> str:
    model, markers = gait
    return " ".join(map(str, model_reasons(model, replace(markers, points=points), y_up=True)))


@pytest.mark.slow
def test_sound_markers_have_no_cause(gait):
    assert cause(gait, gait[1].points) == ""


@pytest.mark.slow
def test_a_wrong_unit_is_named(gait):
    text = cause(gait, 1e3 * gait[1].points)
    assert text.startswith("The unit of the trial is wrong by a factor of 1000: corrected, the markers are 19 mm")


@pytest.mark.slow
def test_a_mirror_image_is_named(gait):
    assert cause(gait, gait[1].points * [1, 1, -1]).startswith("The trial is a mirror image")


@pytest.mark.slow
@pytest.mark.parametrize("pair", [("R.ASIS", "L.ASIS"), ("R.Heel", "R.Toe.Tip")])
def test_two_exchanged_labels_are_named(gait, pair):
    labels, points = gait[1].labels, np.array(gait[1].points)
    first, second = (labels.index(label) for label in pair)
    points[:, [first, second]] = points[:, [second, first]]
    text = cause(gait, points)
    assert "are exchanged: corrected" in text
    assert all(label in text for label in pair)


def test_a_model_that_lies_is_named_with_the_axis():
    upright = np.broadcast_to(np.eye(3), (4, 3, 3))
    lying = upright @ rotations.about(np.array([1.0, 0, 0]), np.pi / 2)
    assert list(lying_reasons(upright, y_up=True)) == []
    assert list(lying_reasons(lying, y_up=False)) == []
    [reason] = lying_reasons(lying, y_up=True)
    assert "90 degrees from upright" in reason.what
    assert "is not Y" in reason.what
