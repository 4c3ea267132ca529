"""The parts of the page's data contain the motion, the curves and the cameras of the results."""

import base64
import json
from dataclasses import replace

import numpy as np
import pytest
from tests.takes import FRAMES
from tests.viewed import FIRST, content, result

from marey.view.viewer import parts as parts_module
from marey.view.viewer.page import viewer_html
from marey.view.viewer.parts import ViewerParts
from marey.view.viewer.viewed import ViewerContent


def test_a_chunk_contains_its_frames_of_the_motion(rng, tmp_path, monkeypatch):
    monkeypatch.setattr(parts_module, "CHUNK", 5)
    parts = ViewerParts(content(rng, tmp_path))
    motion = parts.content.results[0].shown.motion
    assert [name for name in parts.names if name.startswith("motion")] == ["motion/0/0", "motion/0/1", "motion/0/2"]
    frames, segments, joints = 5, len(motion.segment_names), len(motion.joint_names)
    held = parts.part("motion/0/1")
    ends = np.cumsum([12 * frames * segments, 12 * frames * joints, 18 * frames * segments])
    assert len(held) == ends[-1]
    rows = slice(5, 10)
    origin = np.frombuffer(held[: ends[0]], "<f4").reshape(frames, segments, 3)
    np.testing.assert_allclose(origin, motion.segment_origin[rows], atol=1e-6)
    centres = np.frombuffer(held[ends[0] : ends[1]], "<f4").reshape(frames, joints, 3)
    np.testing.assert_allclose(centres, motion.joint_centres[rows], atol=1e-6)
    rotation = np.frombuffer(held[ends[1] :], "<i2").reshape(frames, segments, 3, 3) / 32767
    # Half a step of the 16-bit integers; frames without a pose have NaN places.
    np.testing.assert_allclose(rotation, np.nan_to_num(motion.segment_rotation[rows]), atol=0.5001 / 32767)


def test_curves_follow_each_other_as_the_page_lists_them(rng, tmp_path):
    parts = ViewerParts(content(rng, tmp_path, second=True))
    data = parts.page_data()
    knee = [group["title"] for group in data["groups"]].index("knee")
    values = np.frombuffer(parts.part(f"curves/{knee}"), "<f4").reshape(-1, FRAMES)
    curves = [curve for plot in data["groups"][knee]["plots"] for curve in plot["curves"]]
    assert len(values) == sum(1 + curve["sd"] + curve["determined"] for curve in curves)
    assert [curve["label"] for curve in curves[:2]] == ["left, walk", "right, walk"]
    first = parts.content.results[0]
    np.testing.assert_allclose(values[0], first.angles_deg[:, first.angle_names.index("left_knee_flexion")], rtol=1e-5)
    # Where the angle is determined follows its standard deviations.
    assert values[2].tolist() == [0.0, 0.0, *[1.0] * (FRAMES - 2)]


def test_where_an_angle_of_a_second_result_is_determined_is_at_the_times_of_the_first(rng):
    walk = result(rng)
    late = replace(result(np.random.default_rng(2), "walk again"), time=walk.time - 1 / 30)
    groups = ViewerParts(ViewerContent(results=[walk, late])).groups
    traces = [trace for group in groups if group.title == "knee" for trace in group.plots[0].curves]
    known = {trace.label: trace.determined for trace in traces}
    own, other = (known[label] for label in known if label.startswith("left, "))
    assert own.tolist() == [False, False, *[True] * (FRAMES - 2)]
    # The second result ends one frame earlier.
    assert other.tolist() == [False, *[True] * (FRAMES - 2), True]


def test_where_angles_are_determined_may_be_unknown(rng, tmp_path):
    plain = replace(result(rng), angles_determined=None)
    data = ViewerParts(ViewerContent(results=[plain], take=None)).page_data()
    assert not any(c["determined"] for group in data["groups"] for plot in group["plots"] for c in plot["curves"])
    assert "dotted, value in parentheses" not in viewer_html(ViewerParts(ViewerContent(results=[plain])))
    assert "dotted, value in parentheses" in viewer_html(ViewerParts(ViewerContent(results=[result(rng)])))


def test_frames_of_a_second_result_are_the_nearest_in_time(rng):
    walk = result(rng)
    late = walk.time + 2.4 / 30
    # The last two times are more than a frame after the end.
    assert walk.rows_at(late).tolist() == [*range(2, 12), -1, -1]
    assert walk.rows_at(walk.time - 1.0).tolist() == [-1] * FRAMES


def test_what_is_not_there_is_not_a_part(rng, tmp_path):
    parts = ViewerParts(content(rng, tmp_path))
    for name in ("motion/0/1", "body/1", "curves/99", "", "motion"):
        with pytest.raises(KeyError):
            parts.part(name)


def test_names_are_text_and_not_markup(rng):
    named = ViewerContent(results=[result(rng, "</script><img src=x onerror=alert(1)>")])
    page = viewer_html(ViewerParts(named))
    assert "<img" not in page
    assert page.count("</script>") == page.count("<script")


def test_the_page_states_its_first_frame_cameras_and_events(rng, tmp_path):
    data = json.loads(json.dumps(ViewerParts(content(rng, tmp_path)).page_data()))
    assert data["first"] == FIRST
    assert [camera["lens"] and camera["lens"]["model"] for camera in data["cameras"]] == [None, 1]
    assert [(event["kind"], event["side"]) for event in data["events"]] == [("strike", "left"), ("off", "right")]
    assert len(base64.b64decode(data["time"])) == 4 * FRAMES
