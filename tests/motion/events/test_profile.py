import numpy as np
import pytest

from marey.motion.events.curves import side_of, without_side
from marey.motion.events.profile import WHOLE_SCORE, profile_scores

ARC = np.sin(np.linspace(0, 2 * np.pi, 101))


def test_a_walk_equal_to_the_mean_of_the_references_has_no_distance():
    walks = [{"left_knee_flexion": ARC + offset, "thorax_tilt": ARC} for offset in (-1.0, 0.0, 1.0)]
    scores = profile_scores(walks[1], walks)
    assert {(each.name, each.side) for each in scores} >= {("knee flexion", "left"), (WHOLE_SCORE, "left")}
    assert all(each.score_deg == pytest.approx(0.0, abs=1e-12) for each in scores)
    assert all(each.reference_worst_deg == pytest.approx(1.5) for each in scores)  # 1 from the mean of -1 and 0


def test_names_of_opensim_models_have_their_sides():
    walks = [{"knee_angle_r": ARC + offset, "pelvis_tilt": ARC} for offset in (0.0, 2.0)]
    scores = {(each.name, each.side): each for each in profile_scores({**walks[0], "hip_flexion_l": ARC}, walks)}
    assert scores["knee angle", "right"].score_deg == pytest.approx(1.0)
    assert ("pelvis tilt", "both") in scores
    assert ("hip flexion", "left") not in scores


def test_walks_without_a_common_angle_have_no_scores():
    assert profile_scores({"elbow_flexion": ARC}, [{"left_knee_flexion": ARC}] * 2) == ()


@pytest.mark.parametrize(
    ("name", "side", "rest"),
    [
        ("left_knee_flexion_deg", "left", "knee_flexion_deg"),
        ("knee_angle_r_deg", "right", "knee_angle_deg"),
        ("hip_flexion_l", "left", "hip_flexion"),
        ("pelvis_tilt_deg", None, "pelvis_tilt_deg"),
    ],
)
def test_a_name_is_its_side_and_the_rest(name, side, rest):
    assert (side_of(name), without_side(name)) == (side, rest)
    assert side_of(rest) is None
