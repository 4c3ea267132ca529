"""The 3-D view of markers and bones: its data are those of the results, upright and scaled to the view."""

import base64
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from marey.geometry import rotations
from marey.io.axes import OPENSIM_FROM_WORLD
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.marker_motion import MarkerMotion
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.view.pages import marker_scene as scene
from marey.view.pages.marker_scene import MarkerPaths
from marey.view.pages.markers_report import MethodView, write_markers_report

FRAMES, LABELS = 7, ("thigh_01", "thigh_02", "<shank>", "C7")
OWNERS = ("thigh", "thigh", "<shank>")
PITCH_M = 2.0
"""Way of the markers from the first frame to the last [m]."""


@pytest.fixture
def paths(rng) -> MarkerPaths:
    """Markers that walk along X, Y up; one is hidden in frame 3, one is filled in frame 2, one is never visible."""
    away = np.linspace(0, PITCH_M, FRAMES)[:, None, None] * np.array([1.0, 0, 0])
    points = rng.normal(size=(1, 4, 3)) + np.array([5.0, 1, 0]) + away
    points[3, 0] = points[:, 3] = np.nan
    filled = np.zeros((FRAMES, 4), bool)
    filled[2, 1] = True
    return MarkerPaths(labels=LABELS, points=points, filled=filled, upright=OPENSIM_FROM_WORLD.T)


@pytest.fixture
def bones(rng) -> BoneMotion:
    """The second bone has no pose in frame 4."""
    rotation = rotations.exp(rng.normal(size=(FRAMES, 2, 3)))
    origin = rng.normal(size=(FRAMES, 2, 3))
    rotation[4, 1] = origin[4, 1] = np.nan
    return BoneMotion(
        segments=("thigh", "<shank>"), rotation=rotation, origin=origin, covariance=np.full((FRAMES, 2, 6, 6), np.nan)
    )  # fmt: skip


def places() -> MarkerMotion:
    return MarkerMotion(labels=LABELS[:3], segments=OWNERS, places=np.zeros((FRAMES, 3, 3)))


def numbers(packed: object, kind: str = "<f4") -> np.ndarray:
    assert isinstance(packed, str)
    return np.frombuffer(base64.b64decode(packed), kind)


def test_the_view_shows_the_markers_and_bones_up_to_one_scale_and_shift(paths, bones):
    data = scene.marker_scene(paths, bones, places(), frames=slice(None), every=1)
    place = numbers(data["place"]).reshape(FRAMES, 4, 3)
    origin = numbers(data["origin"]).reshape(FRAMES, 2, 3)
    upright = paths.points @ paths.upright.T
    # The vertical of the laboratory, Y, is that of the view, Z.
    np.testing.assert_array_equal(upright[..., 2], paths.points[..., 1])
    scale = PITCH_M / np.linalg.norm(place[-1, 1] - place[0, 1])
    shift = upright[0, 1] - scale * place[0, 1]
    np.testing.assert_allclose(scale * place + shift, upright, atol=1e-5)
    np.testing.assert_allclose(scale * origin + shift, bones.origin @ paths.upright.T, atol=1e-5)
    turn = numbers(data["rotation"]).reshape(FRAMES, 2, 3, 3)
    np.testing.assert_allclose(turn, paths.upright @ bones.rotation, atol=1e-6)
    assert numbers(data["filled"], "u1").reshape(FRAMES, 4).sum() == 1
    assert data["owner"] == [0, 0, 1, -1]


def test_what_is_missing_stays_missing_and_the_middle_does_not_jump_there(paths, bones):
    data = scene.marker_scene(paths, bones, places(), frames=slice(None), every=1)
    place = numbers(data["place"]).reshape(FRAMES, 4, 3)
    np.testing.assert_array_equal(np.isfinite(place), np.isfinite(paths.points))
    np.testing.assert_array_equal(np.isfinite(numbers(data["rotation"]).reshape(FRAMES, 2, 9)[..., 0]), bones.answered)
    # All markers move alike, so that their middle goes the same way in every frame, also where one is hidden.
    step = np.diff(numbers(data["middle"]).reshape(FRAMES, 3), axis=0)
    np.testing.assert_allclose(step, np.broadcast_to(step[0], step.shape), atol=1e-6)


def test_a_trial_without_any_marker_has_an_empty_view(paths, bones):
    nothing = replace(paths, points=np.full_like(paths.points, np.nan))
    data = scene.marker_scene(nothing, bones, places(), frames=slice(None), every=1)
    assert np.isnan(numbers(data["place"])).all()
    assert np.isfinite(numbers(data["middle"])).all()


def page(tmp_path, paths, bones, *, requested=None) -> str:
    joints = JointKinematics(
        angle_names=(), angles=np.zeros((FRAMES, 0)), angles_sd=np.zeros((FRAMES, 0)), translation_names=(),
        translations=np.zeros((FRAMES, 0)), translations_sd=np.zeros((FRAMES, 0)),
    )  # fmt: skip
    method = MethodView(name="rigid", summary="", motion=bones, joints=joints, markers=places(), seconds=0.1)
    write_markers_report(
        tmp_path / "report.html", title="walk", time=np.arange(FRAMES) / 100, paths=paths, methods=[method],
        requested=np.ones(FRAMES, bool) if requested is None else requested, anatomical=True, notes=(), filled=1,
        timings={}, settings={},
    )  # fmt: skip
    return (tmp_path / "report.html").read_text(encoding="utf-8")


def embedded(text: str) -> dict:
    return json.loads(re.search(r'<script id="data"[^>]*>(.*?)</script>', text, re.DOTALL)[1])


def test_the_page_has_the_view_and_names_are_text(tmp_path, paths, bones):
    text = page(tmp_path, paths, bones)
    data = embedded(text)
    assert (data["rate"], data["stride"], data["first"]) == (pytest.approx(100), 1, 0)
    assert data["markers"]["labels"] == list(LABELS)
    assert "<shank>" not in text
    assert 'id="play"' in text
    assert "this view needs WebGL, which this browser does not provide" in text
    assert "To keep the page small" not in text


def test_the_view_has_the_requested_frames_and_is_thinned_out_if_they_are_many(tmp_path, paths, bones, monkeypatch):
    # Five frames with 4 markers and 2 bones are 60 places: every second frame is shown.
    monkeypatch.setattr(scene, "_MOST_PLACES", 30)
    requested = np.r_[False, np.ones(5, bool), False]
    text = page(tmp_path, paths, bones, requested=requested)
    data = embedded(text)
    assert (data["first"], data["markers"]["every"], len(numbers(data["time"]))) == (1, 2, 5)
    rows = numbers(data["markers"]["place"]).reshape(3, 4, 3)
    assert np.isnan(rows[1, 0]).all()
    assert np.isfinite(rows[[0, 2], 0]).all()
    assert "the view shows one of 2 frames of the curves" in text
