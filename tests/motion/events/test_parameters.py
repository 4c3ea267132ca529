from dataclasses import replace

import numpy as np
import pytest
from tests import made_stairs, made_steps

from marey.motion.events.curves import average_over_cycles, cycle_marks
from marey.motion.events.cycles import OFF, STRIKE, GaitCycle, GaitEvent
from marey.motion.events.detection import find_events
from marey.motion.events.feet import FootPath
from marey.motion.events.parameters import QUANTITIES, measure_gait
from marey.motion.events.summaries import summarise_gait


def true_events(seconds: float = 5.0, sd_s: float | None = 0.01) -> list[GaitEvent]:
    found = []
    for side in ("left", "right"):
        for strike in made_steps.strikes(side, seconds):
            found.append(GaitEvent(kind=STRIKE, side=side, time=float(strike), source="given", sd_s=sd_s))
            off = float(strike + made_steps.OFF_SHARE * made_steps.CYCLE_S)
            found.append(GaitEvent(kind=OFF, side=side, time=off, source="given", sd_s=sd_s))
    return found


@pytest.mark.parametrize("belt", [False, True])
def test_a_made_walk_has_the_lengths_and_times_that_it_was_made_with(belt: bool):
    measures = measure_gait(made_steps.made_walk(belt=belt), true_events())
    cycle, off = made_steps.CYCLE_S, made_steps.OFF_SHARE * made_steps.CYCLE_S
    expected = {
        "speed": 1.2, "cadence": 120 / cycle, "stride_time": cycle, "stride_length": 1.32, "step_time": cycle / 2,
        "step_length": 0.66, "step_width": 0.12, "stance_time": off, "swing_time": cycle - off, "stance_share": 62.0,
        "single_support": cycle - off, "double_support": 2 * off - cycle, "foot_progression": 0.0,
    }  # fmt: skip
    for side in ("left", "right"):
        for name, value in expected.items():
            found, sds = measures.of(name, side)
            assert len(found) >= 3, name
            np.testing.assert_allclose(found, value, atol=1e-6)
            assert (sds >= 0).all()


def test_a_foot_that_points_outward_and_higher_steps_are_measured():
    walk = made_steps.made_walk()
    turn = np.radians(12.0)
    feet = []
    for foot in walk.feet:
        assert foot.toe is not None
        out = -1.0 if foot.side == "right" else 1.0
        along = foot.toe - foot.heel
        c, s = np.cos(out * turn), np.sin(out * turn)
        turned = along @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        feet.append(FootPath(side=foot.side, heel=foot.heel, toe=foot.heel + turned))
    measures = measure_gait(replace(walk, feet=tuple(feet)), true_events())
    for side in ("left", "right"):
        np.testing.assert_allclose(measures.of("foot_progression", side)[0], 12.0, atol=1e-6)


@pytest.mark.parametrize("steps", [made_steps.SLOW, made_steps.RUN, made_steps.FAST_RUN])
@pytest.mark.parametrize("belt", [False, True])
def test_slow_walks_and_runs_have_their_events_and_lengths(steps: made_steps.Steps, belt: bool):
    walk = made_steps.made_walk(seconds=6.0, belt=belt, steps=steps)
    events = find_events(walk)
    for side in ("left", "right"):
        found = [e.time for e in events if (e.kind, e.side) == (STRIKE, side)]
        np.testing.assert_allclose(found, made_steps.strikes(side, 6.0, steps), atol=0.015)
    measures = measure_gait(walk, events)
    lengths = measures.of("stride_length")[0]
    np.testing.assert_allclose(lengths, steps.stride_m, rtol=0.01)
    np.testing.assert_allclose(measures.of("speed")[0], steps.stride_m / steps.cycle_s, rtol=0.01)
    flight = steps.off < 0.5
    assert (measures.of("double_support")[0] == 0).all() == flight


def test_a_run_has_no_double_support():
    events = []
    for side, delay in (("left", 0.0), ("right", 0.35)):
        for start in np.arange(delay, 5.0, 0.7):
            events += [
                GaitEvent(kind=STRIKE, side=side, time=float(start), source="given"),
                GaitEvent(kind=OFF, side=side, time=float(start + 0.25), source="given"),
            ]
    measures = measure_gait(made_steps.made_walk(), events)
    assert set(measures.of("double_support")[0]) == {0.0}
    np.testing.assert_allclose(measures.of("single_support")[0], 0.25)


def test_what_is_not_known_is_nan_and_not_counted():
    walk = made_steps.made_walk(toes=False)
    only_left = [e for e in true_events() if e.side == "left"]
    measures = measure_gait(walk, only_left)
    assert {c.side for c in measures.cycles} == {"left"}
    for name in ("step_length", "step_width", "double_support", "foot_progression", "toe_clearance"):
        assert len(measures.of(name)[0]) == 0
    assert len(measures.of("stride_length")[0]) == len(measures.cycles)
    assert measure_gait(walk, []).values.shape == (0, len(QUANTITIES))
    unsure = measure_gait(walk, true_events(sd_s=None))
    assert np.isnan(unsure.of("stride_time")[1]).all()


def test_the_interval_of_a_mean_is_that_of_student_and_of_the_events():
    """Stride times of 1.0, 1.1 and 1.2 s: a standard error of 0.0577 s and t = 4.303 with two degrees of freedom."""
    times = [0.0, 1.0, 2.1, 3.3]
    events = [GaitEvent(kind=STRIKE, side="left", time=t, source="given", sd_s=0.01) for t in times]
    (entry,) = [
        s for s in summarise_gait(measure_gait(made_steps.made_walk(), events))
        if (s.quantity, s.side) == ("stride_time", "left")
    ]  # fmt: skip
    assert (entry.cycles, entry.unit) == (3, "s")
    assert entry.value == pytest.approx(1.1)
    assert entry.sd == pytest.approx(0.1)
    assert entry.high - entry.value == pytest.approx(np.hypot(4.30265 * 0.1 / np.sqrt(3), 1.95996 * 0.01 * np.sqrt(2)))
    assert entry.value - entry.low == pytest.approx(entry.high - entry.value)


def test_a_limp_is_an_asymmetry_with_its_sign():
    events = [replace(e, time=e.time - 0.05) if (e.kind, e.side) == (OFF, "left") else e for e in true_events()]
    found = {(s.quantity, s.side): s for s in summarise_gait(measure_gait(made_steps.made_walk(), events))}
    off = made_steps.OFF_SHARE * made_steps.CYCLE_S
    entry = found["stance_time_asymmetry", "both"]
    assert entry.unit == "%"
    assert entry.value == pytest.approx(-100 * 0.05 / (off - 0.025))
    assert entry.low < entry.value < entry.high
    assert ("cadence_asymmetry", "both") not in found


def test_curves_follow_the_cycles_of_their_own_side_and_marks_stand_at_the_events():
    cycles = [
        GaitCycle(side="left", start=0.0, end=1.0, off=0.6), GaitCycle(side="right", start=0.5, end=1.5, off=1.15)
    ]  # fmt: skip
    time = np.arange(0, 2, 0.01)
    names = ["left_knee_deg", "knee_angle_r_deg", "trunk_deg"]
    curves = average_over_cycles(names, np.stack([time, time, time], 1), time, cycles)
    assert curves is not None
    np.testing.assert_allclose(curves.mean[[0, 100]], [[0.0, 0.5, 0.5], [1.0, 1.5, 1.5]], atol=1e-9)
    assert curves.sides == ("left", "right", "right")
    assert np.isnan(curves.spread).all()  # of one cycle
    strike = GaitEvent(kind=STRIKE, side="right", time=0.5, source="given")
    marks = {(m.side, m.own): m.percent for m in cycle_marks(cycles, [strike])}
    assert marks == {
        ("left", True): pytest.approx(60),
        ("left", False): pytest.approx(50),
        ("right", True): pytest.approx(65),
    }
    assert average_over_cycles(names, np.zeros((3, 3)), np.arange(3.0), []) is None


@pytest.mark.parametrize("name", made_stairs.STAIRS)
def test_lengths_on_stairs_are_horizontal_and_no_clearance_is_measured_there(name):
    """A heel that follows the toe moves by some 20 mm in 0.1 s; of 40 frames one may differ between two strikes."""
    steps = made_stairs.STAIRS[name]
    events = [GaitEvent(kind=STRIKE, side=side, time=float(at), source="given")
              for side in ("left", "right") for at in made_stairs.stair_strikes(steps, side)]  # fmt: skip
    events += [replace(event, kind=OFF, time=event.time + steps.off * steps.cycle_s) for event in events]
    measures = measure_gait(made_stairs.stair_walk(steps, seconds=8.0), sorted(events, key=lambda event: event.time))
    lengths, _ = measures.of("stride_length")
    np.testing.assert_allclose(lengths, steps.stride_m, atol=1e-3)
    clearances, _ = measures.of("toe_clearance")
    assert not len(clearances) or steps.rise_m == 0
