import numpy as np

from marey.motion.events.cycles import OFF, STRIKE, GaitCycle, GaitEvent, gait_cycles, over_cycles


def event(kind: str, side: str | None, time: float) -> GaitEvent:
    return GaitEvent(kind=kind, side=side, time=time, source="given")


def test_a_cycle_goes_from_a_strike_to_the_next_of_the_same_foot():
    events = [event(STRIKE, "left", t) for t in (2.1, 0.1, 1.1)]
    events += [event(STRIKE, "right", 0.6), event(STRIKE, "right", 9.0), event(OFF, "left", 0.7)]
    cycles = gait_cycles(events)
    assert [(c.side, c.start, c.end, c.off) for c in cycles] == [("left", 0.1, 1.1, 0.7), ("left", 1.1, 2.1, None)]


def test_curves_over_the_cycle_are_linear_between_frames_and_keep_gaps():
    time = np.arange(11) / 10
    values = np.stack([time, time**2], -1)
    values[5, 1] = np.nan
    cycles = [GaitCycle(side=None, start=0.0, end=1.0, off=None), GaitCycle(side=None, start=0.5, end=1.5, off=None)]
    curves = over_cycles(values, time, cycles)
    assert curves.shape == (2, 101, 2)
    np.testing.assert_allclose(curves[0, :, 0], np.linspace(0, 1, 101), atol=1e-12)
    np.testing.assert_array_equal(np.isnan(curves[0, :, 1]), np.abs(np.arange(101) - 50) < 10)
    assert np.isfinite(curves[1, :51, 0]).all()
    assert np.isnan(curves[1, 51:, 0]).all()


def test_no_cycles_give_no_curves():
    assert over_cycles(np.zeros((4, 2)), np.arange(4.0), []).shape == (0, 101, 2)
