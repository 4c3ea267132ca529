import re

import numpy as np
from tests import scenes
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
