import numpy as np
import pytest

from marey.errors import MareyError
from marey.markers.data.force_plates import ForcePlate
from marey.markers.preprocessing.gait_events import GaitEventSettings, events_from_force, events_from_markers
from marey.motion.gait import OFF, STRIKE


def walking_heel(rate: float, *, treadmill: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A heel (F, 3) that stands for 60 % of each second and swings for the rest, the body, and the strikes [s]."""
    time = np.arange(0, 4, 1 / rate)
    phase = time % 1
    swing = np.clip((phase - 0.6) / 0.4, 0, 1)
    ahead = np.floor(time) + swing - np.sin(2 * np.pi * swing) / (2 * np.pi)
    height = 0.03 + 0.1 * np.sin(np.pi * swing) ** 2
    body = np.stack([time, 0 * time, 0.9 + 0 * time], -1)
    heel = np.stack([ahead, 0.1 + 0 * time, height], -1)
    if treadmill:
        body, heel = body - body[:, :1] * [1, 0, 0], heel - body[:, :1] * [1, 0, 0]
    return heel, body, np.array([1.0, 2.0, 3.0])


@pytest.mark.parametrize("treadmill", [True, False])
@pytest.mark.parametrize("turned", [True, False])
def test_a_heel_strikes_when_it_comes_down(treadmill: bool, turned: bool):
    heel, body, strikes = walking_heel(200, treadmill=treadmill)
    axes = np.eye(3)[[1, 2, 0]] if turned else np.eye(3)
    found = events_from_markers(heel @ axes.T, body @ axes.T, rate=200, side="left", up=axes[:, 2])
    assert [(e.kind, e.side, e.source) for e in found] == [(STRIKE, "left", "markers")] * 3
    np.testing.assert_allclose([e.time for e in found], strikes, atol=0.03)


def test_a_toe_leaves_the_floor_when_it_is_farthest_behind():
    heel, body, _ = walking_heel(200, treadmill=True)
    found = events_from_markers(heel, body, rate=200, toe=heel, start_s=5.0)
    offs = [e.time for e in found if e.kind == OFF]
    # 0.6 is where it begins to move; behind the body it gets until it is as fast as the belt.
    np.testing.assert_allclose(offs, 5 + np.arange(4) + 0.66, atol=0.02)


def test_the_settings_limit_cycles_and_contacts():
    heel, body, _ = walking_heel(200, treadmill=True)
    rare = events_from_markers(heel, body, rate=200, settings=GaitEventSettings(shortest_cycle_s=2.5))
    assert 0 < len(rare) < 3
    load = np.zeros(3000)
    load[500:1200] = 700.0
    assert len(events_from_force([plate(load)], {}, rate=100.0)) == 2
    assert events_from_force([plate(load)], {}, rate=100.0, settings=GaitEventSettings(shortest_contact_s=5.0)) == ()


def test_a_heel_that_is_never_seen_with_the_body_is_an_error():
    heel = np.full((50, 3), np.nan)
    with pytest.raises(MareyError, match="never visible together"):
        events_from_markers(heel, np.zeros((50, 3)), rate=100)


def plate(load: np.ndarray) -> ForcePlate:
    corners = np.array([[0.4, 0.3, 0], [0, 0.3, 0], [0, 0, 0], [0.4, 0, 0.0]])
    force = load[:, None] * [0, 0, 1.0]
    return ForcePlate(name="force_plate_1", corners=corners, rate=1000.0, force=force, moment=np.zeros((len(load), 3)))


def test_a_contact_gives_a_strike_and_an_off_of_the_foot_that_stays_on_the_plate():
    load = np.zeros(3000)
    load[500:1200] = 700.0
    load[2000:2050] = 700.0  # too short for a step
    load[2500:] = 700.0  # cut off by the end of the trial
    on, off = np.tile([0.25, 0.2, 0.0], (300, 1)), np.tile([0.2, 0.1, 0.1], (300, 1))
    off[:, 0] += np.linspace(-1, 1, 300)
    events = events_from_force([plate(load)], {"left": off, "right": on}, rate=100.0, start_s=1.0)
    assert [(e.kind, e.side, round(e.time, 3)) for e in events] == [
        (STRIKE, "right", 1.5), (OFF, "right", 2.2), (STRIKE, "right", 3.5),
    ]  # fmt: skip
    assert {e.side for e in events_from_force([plate(load)], {}, rate=100.0)} == {None}
