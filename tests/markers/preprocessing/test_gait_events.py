import numpy as np

from marey.markers.data.force_plates import ForcePlate
from marey.markers.preprocessing.gait_events import ContactSettings, events_from_force
from marey.motion.events.cycles import OFF, STRIKE


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


def test_the_shortest_contact_is_a_setting_and_the_error_that_of_the_sampling():
    load = np.zeros(3000)
    load[500:1200] = 700.0
    found = events_from_force([plate(load)], {}, rate=100.0)
    assert [e.sd_s for e in found] == [1e-3 / np.sqrt(12)] * 2
    assert events_from_force([plate(load)], {}, rate=100.0, settings=ContactSettings(shortest_contact_s=5.0)) == ()
