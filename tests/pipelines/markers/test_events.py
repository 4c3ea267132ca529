from pathlib import Path

import numpy as np
import pytest
from tests import made_steps

from marey.io.axes import OPENSIM_FROM_WORLD, change_point_axes
from marey.io.markers.trial_file import MarkerFile
from marey.markers.data.trajectories import trajectories
from marey.motion.events.cycles import GIVEN, STRIKE, GaitEvent
from marey.pipelines.markers.events import _FOOT, find_gait


def trial(labels: dict[str, str], *, y_up: bool = False, events: tuple[GaitEvent, ...] = ()) -> MarkerFile:
    """The made walk as markers: `labels` are those of left heel, left toe, right heel, right toe, and pelvis."""
    walk = made_steps.made_walk()
    points = {"pelvis": walk.body}
    for foot in walk.feet:
        assert foot.toe is not None
        points |= {f"{foot.side} heel": foot.heel, f"{foot.side} toe": foot.toe}
    places = np.stack([points[what] for what in labels], 1)
    if y_up:
        places = change_point_axes(OPENSIM_FROM_WORLD, places)
    return MarkerFile(
        path=Path("walk.c3d"), trajectories=trajectories(list(labels.values()), places, walk.rate, start_s=2.0),
        y_up=y_up, events=events,
    )  # fmt: skip


PLUG_IN = {"left heel": "LHEE", "left toe": "LTOE", "right heel": "RHEE", "right toe": "RTOE", "pelvis": "SACR"}
OPENSIM = {"left heel": "L.Heel", "left toe": "L.Toe.Tip", "right heel": "R.Heel", "pelvis": "V.Sacral"}


@pytest.mark.parametrize("y_up", [False, True])
def test_a_walk_has_events_and_lengths_whatever_axis_points_up(y_up: bool):
    gait = find_gait(trial(PLUG_IN, y_up=y_up), (), side=None)
    left = [e.time for e in gait.events if (e.kind, e.side) == (STRIKE, "left")]
    np.testing.assert_allclose(left, 2.0 + made_steps.strikes("left"), atol=0.015)
    assert {e.source for e in gait.events} == {"markers"}
    assert gait.parameter("stride length").value == pytest.approx(made_steps.STRIDE_M, abs=1e-3)
    assert gait.parameter("step width").value == pytest.approx(made_steps.WIDTH_M, abs=1e-3)
    assert "found from LHEE, LTOE, RHEE, RTOE: 9 foot strikes, 9 foot offs, 7 complete cycles" in gait.notes[0]


def test_a_foot_without_a_toe_has_strikes_alone():
    gait = find_gait(trial(OPENSIM), (), side=None)
    assert {(e.kind, e.side) for e in gait.events} == {("strike", "left"), ("off", "left"), ("strike", "right")}


def test_events_of_the_file_are_used_as_they_are():
    given = tuple(GaitEvent(kind=STRIKE, side="left", time=2.3 + 1.1 * k, source=GIVEN) for k in range(3))
    gait = find_gait(trial(PLUG_IN, events=given), (), side=None)
    assert gait.events == given
    entry = gait.parameter("stride length", "left")
    assert entry.value == pytest.approx(made_steps.STRIDE_M, abs=1e-3)
    assert np.isnan(gait.parameter("stride time", "left").low)  # their error is not known


def test_a_trial_without_heels_has_no_gait():
    gait = find_gait(trial({"pelvis": "SACR", "left toe": "LTOE"}), (), side=None)
    assert gait.events == ()
    assert gait.parameters == ()


def test_feet_of_every_set_are_found_for_gait_events():
    for label in ("LHEE", "r_calc_study", "R_FCC", "LFCC", "r_toe_study", "L_FM2", "R.Toe.Tip", "LCAL"):
        assert _FOOT.fullmatch(label) is not None
    assert _FOOT.fullmatch("r_5meta_study") is None
