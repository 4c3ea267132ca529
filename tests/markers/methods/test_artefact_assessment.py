from dataclasses import replace

import numpy as np
import pytest
from tests.skin_clusters import leg_bones, placed, problem, rigid_leg, smooth_motion, thigh, turns

from marey.errors import MareyError
from marey.geometry import rotations
from marey.markers.data.rigid_fit import rigid
from marey.markers.methods.artefact_assessment import artefact_assessment, assess


def leg_with_skin(rng, shape, slide, bones, frames):
    """The thigh's markers slide with the square of the knee's flexion, the shank's do not."""
    flexion = turns(bones["thigh"][0], bones["shank"][0])
    skin = (flexion**2)[:, None, None] * slide
    points = {"thigh": placed(*bones["thigh"], shape + skin), "shank": placed(*bones["shank"], -shape[:7])}
    return problem(bones, points, frames=frames)


def test_skin_seen_in_an_exercise_with_known_bones_is_removed_in_the_activity(rng):
    shape, slide = thigh(rng, 9), rng.normal(0, 0.012, (9, 3))
    exercise_bones, bones = leg_bones(rng, 50), leg_bones(rng, 40)
    exercise = leg_with_skin(rng, shape, slide, exercise_bones, list(range(50)))
    activity = replace(leg_with_skin(rng, shape, slide, bones, [0]), exercise=exercise)
    motion, plain = artefact_assessment(activity), rigid(activity)
    assert turns(motion.rotation[:, 0], bones["thigh"][0]).max() < 1e-7
    assert turns(plain.rotation[:, 0], bones["thigh"][0]).max() > 1e-2


def held_knee(rng, frames: int):
    """A pelvis, and a leg that swings at the hip with the knee held still."""
    swing = rotations.about(np.array([0.0, 0.0, 1.0]), 0.5 * np.sin(2 * np.pi * np.arange(frames) / frames))
    pelvis = (np.broadcast_to(np.eye(3), (frames, 3, 3)), np.zeros((frames, 3)))
    return {"pelvis": pelvis, "thigh": (swing, np.zeros((frames, 3))), "shank": (swing, np.zeros((frames, 3)))}


def test_with_a_knee_at_rest_the_thigh_moves_with_the_shank(rng):
    shape, slide = thigh(rng, 9), rng.normal(0, 0.02, (9, 3))

    def trial(bones):
        skin = rotations.log(bones["thigh"][0])[:, 2, None, None] * slide
        points = {name: placed(*bone, shape + (skin if name == "thigh" else 0)) for name, bone in bones.items()}
        return problem(bones, points, frames=[0])

    bones = held_knee(rng, 30)
    knee = rotations.about(np.array([0.0, 0.0, 1.0]), -0.6 + 0.6 * np.cos(2 * np.pi * np.arange(30) / 30))
    bones["shank"] = (bones["thigh"][0] @ knee, bones["thigh"][1])
    activity = replace(trial(bones), exercise=trial(held_knee(rng, 60)))
    motion = artefact_assessment(activity)
    assert turns(motion.bone("thigh")[0], bones["thigh"][0]).max() < 1e-6
    assert turns(rigid(activity).bone("thigh")[0], bones["thigh"][0]).max() > 5e-3
    assert any("shank: the exercise does not show its bone" in note for note in motion.notes)


def test_turns_beyond_the_exercise_are_reported(rng):
    shape, slide = thigh(rng, 9), rng.normal(0, 0.01, (9, 3))
    bones = leg_bones(rng, 40)
    full = leg_with_skin(rng, shape, slide, bones, [0])
    half = leg_with_skin(rng, shape, slide, {n: (r[:12], o[:12]) for n, (r, o) in bones.items()}, list(range(12)))
    motion = artefact_assessment(replace(full, exercise=half))
    assert any("of 40 frames rotate beyond" in note for note in motion.notes)


def test_no_exercise_or_an_uninformative_one_is_an_error(rng):
    leg = rigid_leg(rng)
    with pytest.raises(MareyError, match="needs a trial of an exercise"):
        artefact_assessment(leg)
    with pytest.raises(MareyError, match="does not determine the skin motion of any segment"):
        artefact_assessment(replace(leg, exercise=rigid_leg(rng)))


def test_a_marker_unknown_to_the_exercise_stays_where_it_was(rng):
    shape, slide = thigh(rng, 9), np.zeros((9, 3))
    bones = leg_bones(rng, 30)
    exercise = leg_with_skin(rng, shape, slide, bones, list(range(30)))
    points = exercise.trajectories.points.copy()
    points[3:, 4] = np.nan
    exercise = replace(exercise, trajectories=replace(exercise.trajectories, points=points))
    learned, _ = assess(exercise)
    assert "thigh_04" not in learned["thigh"].coefficients
    activity = replace(leg_with_skin(rng, shape, slide, bones, [0]), exercise=exercise)
    assert turns(artefact_assessment(activity).rotation[:, 0], bones["thigh"][0]).max() < 1e-9


def test_the_walk_of_one_leg_without_joints_is_counted_in_the_laboratory(rng):
    rotation, origin = smooth_motion(rng, 40)
    points = {"thigh": placed(rotation, origin, thigh(rng, 8))}
    exercise = problem({"thigh": (rotation, origin)}, points, frames=list(range(40)))
    learned, _ = assess(exercise)
    assert learned["thigh"].axis.parent is None


def test_an_exercise_without_markers_is_an_error(rng):
    leg = rigid_leg(rng)
    empty = replace(leg.trajectories, points=np.full_like(leg.trajectories.points, np.nan))
    with pytest.raises(MareyError, match="thigh: none of its markers is visible"):
        artefact_assessment(replace(leg, exercise=replace(leg, trajectories=empty)))


def test_a_segment_that_the_exercise_does_not_show_is_fitted_rigidly_and_reported(rng):
    shape, slide = thigh(rng, 9), rng.normal(0, 0.012, (9, 3))
    bones = leg_bones(rng, 40)
    exercise = leg_with_skin(rng, shape, slide, bones, list(range(40)))
    points = exercise.trajectories.points.copy()
    points[:, :9] = np.nan
    exercise = replace(exercise, trajectories=replace(exercise.trajectories, points=points))
    activity = replace(leg_with_skin(rng, shape, slide, bones, [0]), exercise=exercise)
    motion = artefact_assessment(activity)
    np.testing.assert_allclose(motion.rotation[:, 0], rigid(activity).rotation[:, 0])
    assert any("thigh: none of its markers" in note for note in motion.notes)
