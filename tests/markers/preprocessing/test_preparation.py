from dataclasses import replace

import numpy as np
import pytest
from tests.skin_clusters import leg_and_bones, rigid_leg, turns

from marey.errors import MareyError
from marey.markers.data.problem import MarkerProblem
from marey.markers.methods.methods import METHODS
from marey.markers.preprocessing.preparation import prepare_problem

PLAIN = [entry for entry in METHODS.values() if not (entry.exercise or entry.joints)]


def without_points(leg: MarkerProblem, frames, markers) -> MarkerProblem:
    points = leg.trajectories.points.copy()
    points[frames, markers] = np.nan
    return replace(leg, trajectories=replace(leg.trajectories, points=points))


def without_pose(leg: MarkerProblem, posture: int, segment) -> MarkerProblem:
    rotation = leg.calibration.rotation.copy()
    rotation[posture, segment] = np.nan
    return replace(leg, calibration=replace(leg.calibration, rotation=rotation))


def test_a_whole_problem_is_left_as_it_is(rng):
    leg = rigid_leg(rng, known=[0, 20])
    ready = prepare_problem(leg)
    assert ready.problem.clusters == leg.clusters
    assert ready.problem.joints == leg.joints
    assert ready.notes == ()


def test_a_posture_without_a_bone_is_removed_and_reported(rng):
    ready = prepare_problem(without_pose(rigid_leg(rng, known=[3, 20]), 1, 0))
    assert ready.problem.calibration.frames.tolist() == [3]
    assert ready.notes == ("The postures of frame 20 are not used, because a bone is unknown there.",)


@pytest.mark.parametrize("entry", PLAIN, ids=lambda entry: entry.name)
def test_every_method_estimates_the_other_segment_when_one_has_no_markers_or_no_pose(entry, rng):
    leg, bones = leg_and_bones(rng, known=[0, 20])
    cases = {
        "none of its markers": without_points(leg, slice(None), slice(0, 9)),
        "not known in any posture": without_pose(leg, slice(None), 0),
    }
    for reason, case in cases.items():
        motion = entry.run(case)
        assert motion.segments == ("thigh", "shank")
        assert not motion.answered[:, 0].any()
        assert turns(motion.rotation[:, 1], bones["shank"][0]).max() < 1e-9
        assert any(reason in note and note.startswith("thigh") for note in motion.notes)


def test_no_markers_at_all_give_no_estimate_and_no_error(rng):
    motion = METHODS["rigid"].run(without_points(rigid_leg(rng), slice(None), slice(None)))
    assert not motion.answered.any()
    assert len(motion.notes) == 2


def test_what_is_left_may_lack_what_a_method_needs_and_the_reason_is_reported(rng):
    with pytest.raises(MareyError, match=r"in 2 postures\. The postures of frame 20 are not used"):
        METHODS["calibration"].run(without_pose(rigid_leg(rng, known=[0, 20]), 1, 0))
