from dataclasses import replace

import numpy as np
from tests.people import stick_person
from tests.takes import small_take

from marey.motion.motion import LOST, MEASURED, NO_PERSON
from marey.pipelines.consistency.result import reasons_of


def found(rng, *, state=None, agreement=None, sd=None, selected=range(12), preset="left_arm"):
    motion, _ = small_take(rng)
    changes = {} if state is None else {"state": np.array(state)}
    changes |= {} if agreement is None else {"agreement": np.tile(agreement, (12, 1))}
    changes |= {} if sd is None else {"joint_centres_sd": np.full_like(motion.joint_centres_sd, sd)}
    return reasons_of(replace(motion, **changes), stick_person(rng, vertices=60), selected, preset=preset)


def test_a_sound_motion_has_no_finding(rng):
    assert found(rng, state=[NO_PERSON] * 2 + [MEASURED] * 10, agreement=(0.95, 0.93)) == []


def test_lost_frames_limit_the_use_and_most_of_them_end_it(rng):
    [few] = found(rng, state=[MEASURED] * 10 + [LOST] * 2)
    assert few.level == "usable with limits"
    assert "frames 10 to 11" in few.what
    [most] = found(rng, state=[MEASURED] * 4 + [LOST] * 8)
    assert most.level == "not usable"
    [none] = found(rng, state=[LOST] * 12)
    assert none.what == "No frame could be measured."


def test_frames_that_were_not_selected_do_not_count(rng):
    assert found(rng, state=[LOST] * 4 + [MEASURED] * 8, selected=range(4, 12)) == []


def test_one_camera_that_agrees_poorly_is_named(rng):
    [finding] = found(rng, state=[MEASURED] * 12, agreement=(0.92, 0.6))
    assert finding.level == "usable with limits"
    assert finding.cameras == ("cam02",)


def test_a_body_elsewhere_than_the_silhouettes_is_not_usable(rng):
    [finding] = found(rng, state=[MEASURED] * 12, agreement=(0.5, 0.6))
    assert finding.level == "not usable"
    assert "cam01 0.50, cam02 0.60" in finding.what


def test_a_part_of_the_person_is_a_possible_cause_of_a_poor_agreement(rng):
    for agreement in ((0.5, 0.6), (0.92, 0.6)):
        [part] = found(rng, state=[MEASURED] * 12, agreement=agreement, preset="upper")
        assert "preset upper" in part.remedy
        whole = found(rng, state=[MEASURED] * 12, agreement=agreement, preset="full")
        assert not any("preset" in finding.remedy for finding in whole)


def test_wide_intervals_are_named(rng):
    [finding] = found(rng, state=[MEASURED] * 12, sd=0.1)
    assert "+- 196 mm" in finding.what
