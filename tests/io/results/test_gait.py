import csv

import numpy as np
import pytest
from tests import made_steps

from marey.errors import FileProblem
from marey.io.opensim.mot_sto import read_table
from marey.io.results.gait import (
    read_cycle_bands,
    read_cycle_csv,
    read_event_csv,
    read_gait_cycles_csv,
    write_cycle_csv,
    write_event_table,
    write_events,
    write_gait_csv,
    write_gait_cycles_csv,
)
from marey.motion.events.cycles import OFF, STRIKE, GaitEvent
from marey.motion.events.detection import find_events
from marey.motion.events.parameters import measure_gait
from marey.motion.events.summaries import summarise_gait


def test_events_are_read_again_with_their_standard_deviations(tmp_path):
    events = (
        GaitEvent(kind=STRIKE, side="left", time=1.25, source="body", sd_s=0.0125),
        GaitEvent(kind=STRIKE, side=None, time=2.5, source="given"),
    )
    write_events(tmp_path / "events.csv", events)
    assert read_event_csv(tmp_path / "events.csv") == events


def test_events_as_a_table_have_rising_times_and_one_column_per_kind(tmp_path):
    events = (
        GaitEvent(kind=STRIKE, side="left", time=1.25, source="body", sd_s=0.0125),
        GaitEvent(kind=OFF, side="right", time=1.25, source="given"),
        GaitEvent(kind=STRIKE, side="left", time=0.5, source="body", sd_s=0.02),
    )
    write_event_table(tmp_path / "events.mot", events)
    table = read_table(tmp_path / "events.mot")
    assert table.columns == ("left_strike", "left_strike_sd", "right_off", "right_off_sd")
    np.testing.assert_array_equal(table.time, [0.5, 1.25])
    np.testing.assert_array_equal(table.values, [[1, 0.02, 0, 0], [1, 0.0125, 1, 0]])


def test_events_of_earlier_versions_are_read_without_standard_deviations(tmp_path):
    (tmp_path / "events.csv").write_text("event,side,time_s,source\nstrike,left,1.250000,markers\n")
    assert read_event_csv(tmp_path / "events.csv") == (
        GaitEvent(kind=STRIKE, side="left", time=1.25, source="markers"),
    )


def test_cycles_are_read_again_and_means_have_one_row_per_quantity_and_side(tmp_path):
    walk = made_steps.made_walk()
    measures = measure_gait(walk, find_events(walk))
    write_gait_cycles_csv(tmp_path / "gait_cycles.csv", measures)
    again = read_gait_cycles_csv(tmp_path / "gait_cycles.csv")
    assert [c.side for c in again.cycles] == [c.side for c in measures.cycles]
    np.testing.assert_allclose(again.values, measures.values, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(again.sds, measures.sds, rtol=1e-5, atol=1e-9)
    entries = summarise_gait(measures)
    write_gait_csv(tmp_path / "gait.csv", entries)
    with (tmp_path / "gait.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(r["quantity"], r["side"]) for r in rows] == [(e.quantity, e.side) for e in entries]
    assert float(rows[0]["value"]) == pytest.approx(entries[0].value, rel=1e-5)


@pytest.mark.parametrize(
    "text", ["", "cycle,side\n1,left\n", "cycle,side,start_s,end_s,off_s,quantity,value,sd\n1,left,x,1,,speed,1,\n"]
)
def test_a_damaged_table_of_cycles_is_named(tmp_path, text: str):
    path = tmp_path / "gait_cycles.csv"
    path.write_text(text)
    if not text:
        assert read_gait_cycles_csv(path).cycles == ()
        return
    with pytest.raises(FileProblem, match=r"gait_cycles\.csv"):
        read_gait_cycles_csv(path)


def test_curves_over_the_cycle_are_read_again_with_their_spread(tmp_path):
    rng = np.random.default_rng(2)
    mean, spread = rng.normal(0, 20, (2, 101, 3))
    spread[:, 1], mean[:, 2] = np.nan, np.nan
    names = ("left_knee_flexion_deg", "pelvis_tilt_deg", "right_knee_distraction_mm")
    write_cycle_csv(tmp_path / "cycles.csv", names, mean, spread)
    bands = read_cycle_bands(tmp_path / "cycles.csv")
    assert tuple(bands) == names
    for k, name in enumerate(names):
        np.testing.assert_allclose(bands[name], np.stack([mean[:, k], spread[:, k]], 1), atol=5e-6)
        np.testing.assert_array_equal(read_cycle_csv(tmp_path / "cycles.csv")[name], bands[name][:, 0])
