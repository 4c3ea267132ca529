"""The report of a calibration: one page with everything in it."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from tests.made_boards import BOARD, made_session
from tests.made_wands import WAND

from marey.calibration.adjustment.solve import LeftOut, solve_session
from marey.calibration.boards.still import join_still
from marey.calibration.quality.finding import Finding
from marey.calibration.quality.views import camera_quality, view_quality
from marey.calibration.quality.volume import capture_grid, volume_accuracy
from marey.calibration.quality.world import in_level_world
from marey.calibration.timing.wand_clocks import StatedDelay
from marey.view.pages.calibration_report import CalibrationReport, calibration_html
from marey.view.pages.html import PageHead


def made_report() -> CalibrationReport:
    session = made_session(cameras=3, pictures=30, seed=5, floor=0)
    solved = in_level_world(solve_session(join_still(session.corners).corners, BOARD))
    views = view_quality(solved)
    grid = capture_grid(solved.state, floor=False)
    return CalibrationReport(
        title="a <session>",
        state=solved.state,
        corners=solved.corners,
        residual=solved.adjusted.residual,
        board=BOARD,
        cameras=camera_quality(solved, views),
        volume=volume_accuracy(solved.state, solved.covariance, solved.corners.sizes, grid),
        views=views,
        findings=[Finding(code="camera-moved", severity="problem", text="It moved.", advice="Fasten it.")],
        left_out=[],
        world="level with the cameras",
        together=True,
        choices=solved.choices,
    )


@pytest.mark.slow
def test_the_page_holds_cameras_boards_and_findings():
    report = made_report()
    page = calibration_html(report)
    assert "a &lt;session&gt;" in page
    assert "It moved." in page
    assert "Fasten it." in page
    judged = PageHead(verdict=("not usable", ["It moved. Fasten it."]), grades=["problem"])
    assert calibration_html(replace(report, head=judged)).count("It moved.") == 1
    cautions = [Finding(code="camera-moved", severity="caution", text=f"Number {k}.", advice="") for k in range(8)]
    folded = calibration_html(replace(report, findings=cautions))
    assert folded.index("Number 6.") < folded.index("<summary>1 more</summary>") < folded.index("Number 7.")
    found = re.search(r'<script id="data" type="application/json">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    rig = json.loads(found[1].replace("\\u003c", "<"))["rig"]
    assert [camera["name"] for camera in rig["cameras"]] == ["cam01", "cam02", "cam03"]
    assert rig["count"] == len(np.unique(report.corners.picture))
    assert "Distortion of the lenses" in page
    assert page.count("data:image/jpeg;base64,") == 4


@pytest.mark.slow
def test_the_tile_of_the_floor_states_whether_it_was_measured():
    report = made_report()
    page = calibration_html(report)
    assert '<span class="value">not measured</span><span class="below">horizontal assumed from the cameras</' in page
    known = calibration_html(replace(report, world="floor"))
    assert '<span class="value">floor</span><span class="below">board on the floor</span>' in known
    assert "not measured" not in known


@pytest.mark.slow
def test_pictures_that_were_left_out_are_counted_apart_from_those_of_single_cameras():
    left_out = [LeftOut(picture=k, camera=camera, reason="blurred") for k, camera in ((0, None), (1, None), (2, 1))]
    page = calibration_html(replace(made_report(), left_out=left_out))
    assert "Left out: 2 pictures of all cameras and 1 picture of single cameras; the table states the reasons." in page


@pytest.mark.slow
def test_the_page_of_a_wand_speaks_of_it_and_states_the_clocks():
    report = made_report()
    unknown = [replace(each, tilt_deg=(np.nan, np.nan)) for each in report.cameras]
    delays = (
        StatedDelay(camera=1, pictures=1.5, sd=0.01, used=True, known=True, drift=2.0, drift_sd=0.005),
        StatedDelay(camera=2, pictures=0.0, sd=0.5, used=False, known=False),
    )
    page = calibration_html(replace(report, board=WAND, cameras=unknown, delays=delays, clock="cam01"))
    assert "of 3 saw the wand" in page
    assert "nan" not in re.sub(r"<script.*?</script>|data:image[^\"]*", "", page, flags=re.DOTALL)
    assert "+2.0000 ± 0.0098" in page
    assert "By how much each camera is later than cam01" in page
    assert "not determined" in page
