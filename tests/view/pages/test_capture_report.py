import base64
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from tests.takes import FRAMES, rig, small_take

from marey.motion.motion import MEASURED
from marey.view.pages import capture_report as report
from marey.view.pages.capture_report import ReportContent, Size, report_html, write_report
from marey.view.pages.curves import NumberTable
from marey.view.pages.html import PageHead, Still
from marey.view.pages.problems import Problem, find_problems
from marey.view.pictures.palette import SEGMENTS, bone_pairs, segment_colours


@pytest.fixture
def content(rng) -> ReportContent:
    motion, posed = small_take(rng)
    return ReportContent(
        title="<walk> & run", motion=motion, body=posed[0].body, rig=rig(),
        sizes=[Size(name="stature", value_m=1.75, sd_m=0.01), Size(name="left thigh", value_m=0.4, sd_m=np.nan)],
        problems=find_problems(motion), stills=[Still(caption="cam01", image=np.zeros((900, 1300, 3), np.uint8))],
        timings={"Start": 3.0, "Poses": 1.0}, settings={"preset": "full", "frames": (1, 5), "start": None},
        files={"motion.npz": "everything"},
    )  # fmt: skip


def embedded(text: str) -> dict:
    found = re.search(r'<script id="data" type="application/json">(.*?)</script>', text, re.DOTALL)
    return json.loads(found[1])


def test_the_report_is_one_file_that_loads_nothing(content, tmp_path):
    write_report(tmp_path / "report.html", content)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    # Links lead to places on the page and to the files beside it; nothing is loaded.
    assert not re.search(r"""src\s*=\s*["'](?!data:)|href\s*=\s*["'](?!#|[\w.]+["'])""", text)
    assert '<a href="motion.npz">' in text
    assert "http" not in text.replace("http-equiv", "")
    assert "&lt;walk&gt; &amp; run" in text


def test_the_embedded_numbers_are_the_motions(content):
    data = embedded(report_html(content))
    centres = np.frombuffer(base64.b64decode(data["joints"]["centres"]), "<f4")
    np.testing.assert_allclose(centres, content.motion.joint_centres.ravel(), rtol=1e-6)
    sd = np.frombuffer(base64.b64decode(data["angles"]["sd"]), "<f4")
    np.testing.assert_allclose(sd, content.motion.angles_deg_sd.ravel(), rtol=1e-6)
    titles = {plot["title"]: [c["label"] for c in plot["curves"]] for plot in data["angles"]["plots"]}
    assert titles == {"trunk flexion": ["trunk flexion"], "knee flexion": ["left", "right"]}


def test_the_replays_own_blending_gives_the_posed_skin(content, rng):
    _, posed = small_take(np.random.default_rng(20060101))
    replay = embedded(report_html(content))["replay"]
    vertices, segments = len(posed[0].vertices), replay["segments"]

    def read(key: str, dtype: str, *shape: int) -> np.ndarray:
        return np.frombuffer(base64.b64decode(replay[key]), dtype).reshape(*shape)

    frame = 4
    turn = read("rotation", "<f4", FRAMES, segments, 3, 3)[frame]
    shift = read("origin", "<f4", FRAMES, segments, 3)[frame] - np.einsum(
        "sab,sb->sa", turn, read("restJoints", "<f4", segments, 3)
    )
    carrier, weight = read("vertexSegments", "u1", vertices, 4), read("vertexWeights", "u1", vertices, 4) / 255
    moved = np.einsum("vnab,vb->vna", turn[carrier], read("rest", "<f4", vertices, 3)) + shift[carrier]
    # Weights are rounded to 1/255, which moves a vertex by less than that share of the segments' distance.
    np.testing.assert_allclose((weight[..., None] * moved).sum(1), posed[frame].vertices, atol=0.02)


def test_sizes_problems_and_settings_are_there_as_text(content):
    text = report_html(content)
    assert "± 2.0" in text
    assert "unknown" in text
    assert "The person was lost in these frames" in text
    assert "<th>frames</th><td>1 to 4</td>" in text
    assert "<th>start</th>" not in text


def test_the_plots_show_the_requested_frames_and_nothing_that_is_empty(content):
    requested = np.zeros(len(content.motion), bool)
    requested[2:7] = True
    angles = np.array(content.motion.angles_deg)
    angles[:, content.motion.angle_names.index("trunk_flexion")] = np.nan
    motion = replace(content.motion, angles_deg=angles)
    data = embedded(report_html(replace(content, motion=motion, requested=requested)))
    assert (data["first"], data["frames"]) == (2, 5)
    time = np.frombuffer(base64.b64decode(data["time"]), "<f4")
    np.testing.assert_allclose(time, content.motion.time[2:7], rtol=1e-6)
    assert [plot["title"] for plot in data["angles"]["plots"]] == ["knee flexion"]


def test_angles_are_a_table_with_range_interval_and_share_of_frames(content):
    motion = content.motion
    measured = motion.state == MEASURED
    determined = np.ones(motion.angles_deg.shape, bool)
    determined[np.flatnonzero(measured)[:2], 1] = False
    [trunk, left, right] = report.angle_table(replace(motion, angles_determined=determined)).rows
    assert (trunk[0], left[0]) == ("trunk flexion", "left knee flexion")
    own = motion.angles_deg[measured, 1]
    assert [float(cell.replace("−", "-")) for cell in left[1:3]] == pytest.approx([own.min(), own.max()], abs=0.051)
    assert float(left[3].removeprefix("± ")) == pytest.approx(1.96 * np.median(np.abs(own) * 0.1), abs=0.051)
    assert [row[4] for row in (trunk, left, right)] == ["100", f"{100 * (1 - 2 / measured.sum()):.0f}", "100"]
    assert {row[4] for row in report.angle_table(motion).rows} == {"unknown"}
    assert report.angle_table(motion.frames([0, 1])) is None
    assert "Table of the angles" in report_html(content)


def test_the_page_knows_where_an_angle_is_not_determined(content):
    assert embedded(report_html(content))["angles"]["determined"] is None
    flags = np.ones(content.motion.angles_deg.shape, bool)
    flags[3, 1] = False
    data = embedded(report_html(replace(content, motion=replace(content.motion, angles_determined=flags))))
    shown = np.frombuffer(base64.b64decode(data["angles"]["determined"]), "u1").reshape(flags.shape)
    np.testing.assert_array_equal(shown, flags)


def test_pelvis_and_thorax_are_shown_in_the_same_turn(content):
    angles = np.array(content.motion.angles_deg)
    heading = np.linspace(165, 188, len(angles))
    angles[:, 0], angles[:, 1] = heading, (heading + 5 + 180) % 360 - 180
    names = ("pelvis_rotation", "thorax_rotation", "right_knee_flexion")
    motion = replace(content.motion, angles_deg=angles, angle_names=names)
    shown = report.shown_angles(motion)
    np.testing.assert_allclose(shown[:, 1] - shown[:, 0], 5)
    np.testing.assert_array_equal(shown[:, 2], angles[:, 2])


def test_the_next_step_names_the_overlays_that_exist(content):
    text = report_html(content)
    assert "What to do next" in text
    assert "overlay_" not in text
    files = {"overlay_cam01.mp4, overlay_cam02.mp4": "the fitted surface over the videos"}
    text = report_html(replace(content, files=files))
    section = text[text.index('id="next"') : text.index('id="replay"')]
    assert section.count('<a href="overlay_') == 2


def test_the_duration_is_the_time_from_the_first_to_the_last_frame(content):
    count = len(content.motion)
    assert f"{(count - 1) / content.motion.rate:.2f} s" in report_html(content)


def test_angles_run_on_through_half_a_turn(content):
    angles = np.array(content.motion.angles_deg)
    run = np.linspace(150, 230, len(angles))
    angles[:, 0] = (run + 180) % 360 - 180
    angles[3, 0] = np.nan
    data = embedded(report_html(replace(content, motion=replace(content.motion, angles_deg=angles))))
    shown = np.frombuffer(base64.b64decode(data["angles"]["values"]), "<f4").reshape(angles.shape)[:, 0]
    np.testing.assert_allclose(np.diff(np.delete(shown, 3)), np.diff(np.delete(run, 3)), atol=1e-4)
    assert abs(np.nanmedian(shown)) <= 180


def test_more_than_seven_problems_are_folded(content):
    many = [Problem(severity="note", where="run", what=f"Note {k}.") for k in range(9)]
    text = report_html(replace(content, problems=many))
    assert "<summary>2 more</summary>" in text
    assert text.index("Note 6.") < text.index("<details>") < text.index("Note 7.")
    assert "<details>" not in report_html(replace(content, problems=many[:7]))


def test_sides_that_the_model_holds_equal_are_one_number(content):
    def sizes(right_m: float) -> str:
        pair = [Size(name=f"{side} thigh", value_m=value, sd_m=0.01) for side, value in
                (("left", 0.4), ("right", right_m))]  # fmt: skip
        text = report_html(replace(content, sizes=pair))
        return text[text.index('class="sizes"') : text.index("Dimensions of the fitted body")]

    assert sizes(0.4).count("40.0") == 1
    assert "cm (left)" not in sizes(0.4)
    assert "41.0" in sizes(0.41)
    assert "cm (left)" in sizes(0.41)


def test_a_take_that_does_not_show_the_whole_body_has_no_stature(content):
    assert ">stature<" in report_html(content)
    arm = [Size(name="left forearm", value_m=0.25, sd_m=0.01)]
    text = report_html(replace(content, sizes=arm))
    assert ">stature<" not in text
    assert "0.250 m" not in text


def test_the_course_of_the_energy_is_shown_where_it_is_known(content):
    assert "Course of silhouettes" not in report_html(content)
    text = report_html(replace(content, rounds=[(-100.0, 0.8), (-180.0, 0.9), (-200.0, 0.91)]))
    assert "Course of silhouettes" in text
    for energy, left in (("-100", "100.0"), ("-180", "20.0"), ("-200", "0.0")):
        assert f'<td>{energy}</td><td class="share"><span style="width: {left}%">' in text
    assert "0.910" in text


def test_tracked_patches_are_listed_by_segment(content):
    assert "Tracked patches" not in report_html(content)
    text = report_html(replace(content, tracks={"left thigh": (52, 14.4)}))
    assert "<tr><th>left thigh</th><td>52</td><td>14</td></tr>" in text


def test_long_takes_are_thinned_out(content, monkeypatch):
    monkeypatch.setattr(report, "MOST_FRAMES", 5)
    data = embedded(report_html(content))
    assert data["stride"] == 3
    assert data["frames"] == 4


def test_a_take_without_a_result_still_gives_a_report(content):
    empty = replace(content, motion=content.motion.frames([0, 1]), problems=(), sizes=())
    assert "None: every frame" in report_html(empty)


def test_every_segment_has_a_colour_of_its_own_and_bones_join_named_joints():
    colours = segment_colours(list(SEGMENTS))
    assert len({tuple(c) for c in colours}) == len(SEGMENTS) == 21
    np.testing.assert_array_equal(bone_pairs(["left_knee", "left_hip", "x"]), [[1, 0]])
    assert bone_pairs(["x"]).shape == (0, 2)


def test_frames_that_were_not_requested_are_not_counted(content):
    requested = np.arange(FRAMES) < 9
    text = report_html(replace(content, requested=requested))
    assert "5 of 7" in text
    assert "1 filled, 1 lost, 2 without a person, 3 not selected" in text


def test_further_tables_follow_the_body_dimensions_and_their_names_are_text(content):
    table = NumberTable(title="Segments", head=("segment", "length cm"), rows=[("<thigh>", "41.2 ± 1.0")])
    text = report_html(replace(content, tables=[table]))
    assert "<th>&lt;thigh&gt;</th><td>41.2 ± 1.0</td>" in text
    assert 'href="#table-1">Segments</a>' in text
    assert text.index('id="person"') < text.index('id="table-1"') < text.index('id="run"')
    assert 'id="table-' not in report_html(content)


def test_a_problem_is_shown_before_the_limits_of_the_verdict_and_none_is_repeated(content):
    grave = [Problem(severity="problem", where="cam01", what=f"Wrong {k}.") for k in range(3)]
    light = [Problem(severity="note", where="run", what=text) for text in ("It is dark.", "A detail.")]
    reasons = ["It is dark. Switch on the light.", *(f"Limit {k}." for k in range(6))]
    head = PageHead(verdict=("usable with limits", reasons), grades=["caution"] * 7)
    text = report_html(replace(content, problems=[*grave, *light], head=head))
    assert text.count("It is dark.") == 1
    # Seven entries: the three problems, and four of the limits.
    order = ["Limit 2.", "<summary>3 more<", "Limit 3.", "Wrong 0.", "Wrong 2.", "<summary>1 more<", "A detail."]
    places = [text.index(each) for each in order]
    assert places == sorted(places)
    text = report_html(replace(content, problems=light[:1], head=head))
    assert "See the verdict above; nothing else was found." in text
