import base64
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from tests import scenes
from tests.pages import broken_links, linked_files
from tests.surfaces import no_points, some_points

from marey.cameras.rig import Rig
from marey.surface.points.refine_rig import RigRefinement
from marey.surface.tracks.filters import FilterSettings, filtered
from marey.surface.tracks.trajectories import Sightings, gathered
from marey.view.pages.html import Still
from marey.view.pages.surface_report import SurfaceReport, write_surface_report

RIG = Rig(tuple(scenes.rig(-10, 0, 10)))


def page(tmp_path, **changes):
    write_surface_report(tmp_path / "surface.html", SurfaceReport(title="face & hand", rate=25.0, rig=RIG, **changes))
    return (tmp_path / "surface.html").read_text()


def parts(rng):
    points = some_points(rng, [3] * 40 + [5] * 20)
    return [points.of_frame(3), no_points(points.camera_names), points.of_frame(5)]


def test_points_frames_and_notes_are_on_the_page_and_nothing_is_loaded(tmp_path, rng):
    still = Still(caption="middle, frame 3", image=np.zeros((20, 30, 3), np.uint8))
    text = page(tmp_path, parts=parts(rng), first=3, notes=["Stills have no rate."], stills=[still])
    assert "face &amp; hand" in text
    assert ">60</span>" in text
    assert "in 2 of 3 frames" in text
    assert "Stills have no rate." in text
    assert "data:image/jpeg;base64," in text
    # The frame without points has a row with empty cells.
    assert re.search(r"<th>4</th><td>0</td><td></td><td></td><td></td>", text)
    assert not re.search(r"(src|href)=\"https?:", text)


def test_one_frame_has_no_curves_over_time(tmp_path, rng):
    text = page(tmp_path, parts=parts(rng)[:1], first=3)
    assert "Frame by frame" not in text
    assert "Residuals and standard deviations" in text


def test_corrected_cameras_and_trajectories_are_on_the_page(tmp_path, rng):
    refined = RigRefinement(
        rig=RIG, rotation=np.array([0.001, 0, 0.002]), shift=np.array([0.001, 0, 0.002]),
        moved_px=np.array([1.2, 0, 1.4]), residual_before=0.4, residual_after=0.3, tuples=600,
    )  # fmt: skip
    rows = [
        Sightings(
            frame=k, count=12, which=np.arange(12), position=np.arange(36.0).reshape(12, 3) / 100 + 0.001 * k,
            covariance=np.tile(1e-8 * np.eye(3), (12, 1, 1)), pixels=np.ones((12, 3, 2)),
        )
        for k in range(3)
    ]  # fmt: skip
    followed = filtered(gathered(rows, np.arange(3), rate=25.0, camera_names=RIG.names), FilterSettings())
    text = page(tmp_path, parts=parts(rng), first=0, refined=refined, followed=followed)
    assert "Cameras corrected" in text
    assert "fell from 0.40 to 0.30 px" in text
    assert "over 3.0 frames on average" in text
    assert "length of trajectories" in text
    assert "share of the trajectories [%] by length [frames]" in text


def scene_of(text: str) -> dict:
    return json.loads(re.search(r'<script id="data"[^>]*>(.*?)</script>', text, re.DOTALL)[1])["surface"]


def places(scene: dict) -> list[np.ndarray]:
    """Return the points (N, 3) of each frame of the view."""
    raw = [np.frombuffer(base64.b64decode(text), "<u2").reshape(-1, 3) for text in scene["places"]]
    return [np.array(scene["low"]) + scene["step"] * each for each in raw]


def test_the_view_shows_the_points_with_their_colours_up_to_one_turn_shift_and_scale(tmp_path, rng):
    measured = parts(rng)
    text = page(tmp_path, parts=measured, first=3)
    scene = scene_of(text)
    # The frame without points is left out.
    assert (scene["frames"], scene["of"]) == ([0, 2], [40, 20])
    shown, known = np.concatenate(places(scene)), np.concatenate([measured[0].points, measured[2].points])
    # Axes of the camera in the middle, whose images are the template: x right, y ahead, z up.
    assert scene["camera"] == RIG.names[1]
    right, down, ahead = RIG.cameras[1].camera_from_world.rotation
    turned = known @ np.stack([right, ahead, -down], 1)
    scale = np.ptp(turned[:, 0]) / np.ptp(shown[:, 0])
    shift = np.mean(turned - scale * shown, axis=0)
    # Half a step of the coded coordinates, and as much again of the shift that is found from them.
    np.testing.assert_allclose(scale * shown + shift, turned, atol=2 * scale * scene["step"])
    colours = np.frombuffer(base64.b64decode(scene["colours"][1]), "u1").reshape(-1, 3)
    np.testing.assert_array_equal(colours, measured[2].colour)
    assert "Shown are 60 of all 60 points, in 2 of 3 frames; surface.npz contains all." in text
    assert "this view needs WebGL" in text
    assert 'id="play"' in text


@pytest.mark.parametrize(("most", "frames", "counts"), [(30, [0, 2], [20, 10]), (10, [0], [10])])
def test_of_many_points_a_part_is_shown_and_the_page_says_of_how_many(
    tmp_path, rng, monkeypatch, most, frames, counts
):
    monkeypatch.setattr("marey.view.pages.surface_report._MOST_SHOWN", most)
    monkeypatch.setattr("marey.view.pages.surface_report._FEWEST_IN_FRAME", 10)
    text = page(tmp_path, parts=parts(rng), first=3)
    scene = scene_of(text)
    assert scene["frames"] == frames
    assert [len(each) for each in places(scene)] == counts
    where = "2 of 3 frames, selected evenly from the 60 there" if most == 30 else "frame 3, selected evenly from the 40"
    assert f"Shown are {most} of all 60 points, in {where}" in text


def test_the_view_of_one_frame_is_still(tmp_path, rng):
    text = page(tmp_path, parts=parts(rng)[:1], first=3)
    assert 'id="play"' not in text
    assert "Shown are 40 of all 40 points, in frame 3; surface.npz contains all." in text


def test_the_name_of_a_camera_is_text_on_the_page(tmp_path, rng):
    rig = Rig(tuple(replace(camera, name=f"<b>{camera.name}") for camera in RIG))
    write_surface_report(
        tmp_path / "surface.html", SurfaceReport(title="face", rate=25.0, rig=rig, parts=parts(rng), first=3)
    )
    text = (tmp_path / "surface.html").read_text()
    assert "<b>" not in text
    assert f"that of the image of &lt;b&gt;{RIG.names[1]}" in text


def test_the_page_links_to_the_files_beside_it_and_to_no_others(tmp_path, rng):
    (tmp_path / "surface").mkdir()
    images = ["surface_left camera.png", "surface_middle.png", "tracks_middle.png"]
    for name in ("surface.npz", "surface.ply", *images):
        (tmp_path / name).write_bytes(b"")
    text = page(tmp_path, parts=parts(rng), first=3)
    expected = ["surface.npz", "surface.ply", "surface/", *images, "run.json"]
    assert [link for link in linked_files(tmp_path / "surface.html") if not link.startswith("#")] == expected
    # The record is written last.
    assert broken_links(tmp_path / "surface.html") == ["run.json"]
    assert "corrected_cameras" not in text
    (tmp_path / "corrected_cameras.toml").write_bytes(b"")
    page(tmp_path, parts=parts(rng), first=3)
    assert "corrected_cameras.toml" in linked_files(tmp_path / "surface.html")


def test_every_curve_has_a_caption_with_its_units(tmp_path, rng):
    text = page(tmp_path, parts=parts(rng), first=3)
    assert "medians of their residuals [px] and standard deviations [mm], over time [s]." in text
    assert "by residual [px] and by standard deviation [mm]." in text
    assert "same statistic" not in text
