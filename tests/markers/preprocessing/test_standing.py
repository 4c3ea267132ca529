"""Finding where a person stands still."""

import numpy as np
import pytest
from tests.marker_set_trials import lower_body, person, standing, walking
from tests.trials import RATE

from marey.markers.data.trajectories import MarkerTrajectories, trajectories
from marey.markers.preprocessing.standing import knee_bend_deg, most_upright_frame, standing_frames

LEGS = [("LASI", "LKNE", "LANK"), ("RASI", "RKNE", "RANK")]
FURTHER = ["LPSI", "RPSI", "LHEE", "RHEE"]
UP = np.array([0.0, 0.0, 1.0])


def trial(*angles, speed: float = 0.0) -> MarkerTrajectories:
    joined = {joint: np.concatenate([part[joint] for part in angles]) for joint in angles[0]}
    points = lower_body(person(joined, speed=speed))
    return trajectories(list(points), np.stack(list(points.values()), 1), RATE)


def test_the_standing_part_of_a_trial_is_found():
    frames = standing_frames(trial(walking(60), standing(90), walking(60)), LEGS, FURTHER, up=UP)
    # Speeds are measured over 0.2 s, so up to 10 frames beside the motion may be left out.
    assert 60 <= frames[0] <= 70
    assert 139 <= frames[-1] <= 149
    np.testing.assert_array_equal(np.diff(frames), 1)


@pytest.mark.parametrize(
    "moving",
    [
        trial(walking(80)), trial(standing(80), speed=1.0), trial(walking(60), standing(40), walking(60)),
        trial(walking(9)),
    ],
    ids=["moving legs", "sliding", "too short", "a short walk"],
)
def test_other_trials_have_no_standing_part(moving):
    assert not len(standing_frames(moving, LEGS, FURTHER, up=UP))


@pytest.mark.parametrize("count", [1, 2, 30])
def test_a_short_trial_may_stand_still_as_a_whole(count):
    assert len(standing_frames(trial(standing(count)), LEGS, FURTHER, up=UP)) == count


def test_a_person_may_stand_with_bent_knees_but_not_sit():
    for bend, stands in ((0.5, True), (1.5, False)):
        angles = standing()
        for joint, share in (("hip", 0.5), ("knee", 1.0), ("ankle", 0.5)):
            angles[joint][:, 0] = share * bend
        angles["hip"][:, 0] = 0.5 * bend if stands else bend
        assert bool(len(standing_frames(trial(angles), LEGS, FURTHER, up=UP))) == stands


def test_a_person_who_lies_does_not_stand():
    assert not len(standing_frames(trial(standing()), LEGS, FURTHER, up=np.array([1.0, 0, 0])))


def test_a_marker_that_is_never_visible_leaves_no_standing_part():
    known = trial(standing())
    points = np.array(known.points)
    points[:, known.labels.index("LHEE")] = np.nan
    hidden = trajectories(known.labels, points, RATE)
    assert not len(standing_frames(hidden, LEGS, FURTHER, up=UP))
    assert most_upright_frame(hidden, LEGS, FURTHER) is None


def test_the_most_upright_frame_has_the_straightest_legs():
    known = trial(walking())
    frame = most_upright_frame(known, LEGS, FURTHER)
    bent = sum(knee_bend_deg(known, leg) for leg in LEGS)
    assert frame == int(np.argmin(bent))
    assert walking()["knee"][frame, 0] < 0.2 * walking()["knee"][:, 0].max()
