from dataclasses import replace

import numpy as np
import pytest
from tests import made_steps, performer
from tests.motion.events.test_body_feet import walking_body

from marey.errors import SettingProblem
from marey.motion.events.detection import find_events
from marey.pipelines.gait.files import body_curves, cycle_group, gait_tables, write_gait
from marey.pipelines.gait.walk import Gait, count_events, gait_from, gait_of_body


def test_quantities_are_found_by_name_and_unknown_ones_are_errors():
    walk = made_steps.made_walk()
    gait = gait_from(walk, find_events(walk))
    assert gait.parameter("stride length", "left").value == pytest.approx(made_steps.STRIDE_M, abs=1e-6)
    assert gait.parameter("speed").side == "both"
    with pytest.raises(SettingProblem, match=r"no quantity 'jumps'.*stride_length"):
        gait.parameter("jumps")
    with pytest.raises(SettingProblem, match="was not measured"):
        gait.parameter("speed_asymmetry")
    assert count_events(gait) == "9 foot strikes, 9 foot offs, 7 complete cycles"


def test_files_are_those_of_the_events_and_cycles(tmp_path):
    walk = made_steps.made_walk()
    write_gait(tmp_path, gait_from(walk, find_events(walk)), None)
    assert {p.name for p in tmp_path.iterdir()} == {"events.csv", "events.mot", "gait.csv", "gait_cycles.csv"}
    nothing = tmp_path / "nothing"
    nothing.mkdir()
    write_gait(nothing, Gait(events=(), cycles=()), None)
    assert list(nothing.iterdir()) == []
    assert gait_tables(None) == []
    assert cycle_group(Gait(events=(), cycles=()), [("", None)]) == []


def test_the_page_has_a_row_per_quantity_and_both_sides():
    walk = made_steps.made_walk()
    (table,) = gait_tables(gait_from(walk, find_events(walk)))
    rows = {row[0]: row for row in table.rows}
    assert rows["stride length [m]"][1] == "1.320 ± 0.000"
    assert rows["stride length [m]"][-1] == "4 + 3"
    assert rows["step width [m]"][5] == ""  # both feet share it
    assert all(len(row) == len(table.head) for row in table.rows)


def test_a_captured_walk_has_the_parameters_it_was_made_with(tmp_path):
    person, motion = performer.body(), walking_body()
    gait = gait_of_body(motion, person)
    assert gait is not None
    assert {event.source for event in gait.events} == {"body"}
    stride = gait.parameter("stride length")
    assert stride.value == pytest.approx(made_steps.STRIDE_M, rel=0.01)
    assert gait.parameter("speed").value == pytest.approx(made_steps.STRIDE_M / made_steps.CYCLE_S, rel=0.01)
    curves = body_curves(gait, motion)
    assert curves is not None
    write_gait(tmp_path, gait, curves)
    assert (tmp_path / "cycles.csv").is_file()
    (group,) = cycle_group(gait, [("", curves)])
    paired = next(plot for plot in group.plots if plot.title == "knee flexion")
    assert {trace.label for trace in paired.curves} == {"left", "right"}
    assert len(paired.marks) == 4  # of each side its off and the strike of the other foot


def test_a_person_who_moves_in_place_has_no_gait():
    person, motion = performer.body(), walking_body()
    still = np.broadcast_to(motion.segment_origin[:1], motion.segment_origin.shape)
    turned = np.broadcast_to(motion.segment_rotation[:1], motion.segment_rotation.shape)
    assert gait_of_body(replace(motion, segment_origin=still, segment_rotation=turned), person) is None


def test_a_mean_over_cycles_is_not_broken_by_angles_that_pass_half_a_turn():
    person, motion = performer.body(), walking_body()
    gait = gait_of_body(motion, person)
    assert gait is not None
    angles = np.array(motion.angles_deg)
    k = motion.angle_names.index("pelvis_rotation")
    angles[:, k] = (180 + 5 * np.sin(2 * np.pi * motion.time / made_steps.CYCLE_S) + 180) % 360 - 180
    curves = body_curves(gait, replace(motion, angles_deg=angles))
    assert curves is not None
    mean = curves.mean[:, curves.names.index("pelvis_rotation_deg")]
    assert np.ptp(mean) == pytest.approx(10.0, abs=0.5)


def test_a_difference_that_rounds_to_zero_has_no_sign():
    walk = made_steps.made_walk()
    (table,) = gait_tables(gait_from(walk, find_events(walk)))
    assert not any(cell.startswith(("−0.0 ", "−0.000 ")) for row in table.rows for cell in row[1:])
