"""Inverse kinematics: truth recovered, derivatives, what stays open, bad input."""

from dataclasses import replace

import numpy as np
import pytest
from tests.jointed import leg, walking

from marey.body.articulation.jointed_kinematics import linearised, new_state, place
from marey.errors import MareyError
from marey.geometry import rotations
from marey.markers.data.trajectories import trajectories
from marey.markers.kinematics.inverse_kinematics import InverseKinematicsSettings, inverse_kinematics
from marey.markers.kinematics.inverse_kinematics_kernels import evaluate
from marey.markers.kinematics.tasks import CoordinateTask, MarkerTask, TaskSet


def filmed(body, values, noise=0.0, labels=None):
    """Give the trial in which a body's markers were seen."""
    labels = labels or tuple(m.label for m in body.markers)
    index, spot = body.marker_bodies(labels)
    points = []
    for posture in values:
        placed = place(body, posture)
        points.append((placed.rotation[index] @ spot[..., None])[..., 0] + placed.origin[index])
    points = np.array(points)
    return trajectories(labels, points + noise * np.random.default_rng(1).normal(size=points.shape), 100.0)


def even(body, *coordinates):
    return TaskSet(markers=tuple(MarkerTask(label=m.label, weight=1.0) for m in body.markers), coordinates=coordinates)


@pytest.mark.parametrize(("h", "which"), [(1e-6, "rotational"), (1e-5, "translational")])
def test_gradient_and_rows_are_differences(h, which):
    body = leg(locked=())
    values = walking(body, 4)[1]
    labels = tuple(m.label for m in body.markers)
    index, spot = body.marker_bodies(labels)
    rng = np.random.default_rng(3)
    observed = rng.normal(size=spot.shape)
    observed[3] = np.nan
    count = len(values)
    markers, tasks = (
        (index, spot, rng.uniform(0.5, 2, len(labels)), observed),
        (rng.uniform(size=count), np.zeros(count)),
    )
    variable, slope, state = np.empty(count, np.int64), np.empty(count), new_state(body.packed)
    hessian, gradient, nothing = np.empty((count, count)), np.empty(count), np.empty((0, 0))
    evaluate(body.packed, markers, tasks, values.copy(), variable, slope, state, hessian, gradient)
    _, jacobian, rotation, _, moved, _ = linearised(body.packed, index, spot, values.copy())
    for c in np.flatnonzero(body.free & (body.rotational if which == "rotational" else ~body.rotational)):
        both = []
        for sign in (1, -1):
            near = values + sign * h * np.eye(count)[c]
            cost, _ = evaluate(body.packed, markers, tasks, near, variable, slope, state, nothing, np.empty(count))
            both.append((cost, *linearised(body.packed, index, spot, near)))
        (up, points_up, _, turned_up, origin_up, *_), (down, points_down, _, turned_down, origin_down, *_) = both
        assert np.isclose(gradient[c], (up - down) / (4 * h), rtol=1e-6, atol=1e-7)
        assert np.allclose(jacobian[:, :, c], (points_up - points_down) / (2 * h), atol=1e-8)
        assert np.allclose(moved[:, 3:, c], (origin_up - origin_down) / (2 * h), atol=1e-8)
        turn = rotations.log(turned_up @ turned_down.transpose(0, 2, 1)) / (2 * h)
        assert np.allclose(moved[:, :3, c], (rotation.transpose(0, 2, 1) @ turn[..., None])[..., 0], atol=1e-7)


def test_exact_markers_give_the_exact_motion_with_splines_couplings_and_locks():
    body = leg()
    truth = walking(body)
    found = inverse_kinematics(body, None, filmed(body, truth))
    assert np.abs(found.coordinates - truth).max() < 1e-7
    placed = place(body, truth[5])
    assert np.allclose(found.bones.rotation[5], placed.rotation, atol=1e-7)
    assert np.allclose(found.bones.origin[5], placed.origin, atol=1e-7)
    locked = body.coordinate("foot_angle")
    assert not found.determined[:, locked].any()
    assert found.determined[:, np.arange(13) != locked].all()
    assert (found.coordinates_sd[:, locked] == 0).all()


def test_the_settings_decide_which_coordinates_are_determined():
    body = leg()
    found = inverse_kinematics(
        body, None, filmed(body, walking(body), 2e-3), settings=InverseKinematicsSettings(largest_sd=1e-9)
    )
    assert np.isnan(found.coordinates[:, body.free]).all()


def test_a_body_that_faces_the_other_way_is_found():
    body = leg()
    truth = walking(body)
    truth[:, body.coordinate("turn")] += 2.9
    found = inverse_kinematics(body, None, filmed(body, truth))
    assert found.rms.max() < 1e-7


@pytest.mark.slow
def test_stated_standard_deviations_contain_the_errors_of_noisy_markers():
    body = leg()
    truth = walking(body, 150)
    found = inverse_kinematics(body, None, filmed(body, truth, 2e-3))
    error = (found.coordinates - truth)[:, body.free] / found.coordinates_sd[:, body.free]
    # 10 coordinates, 150 frames each: the mean square of whitened errors is 1 within 5 of its deviations.
    assert abs((error**2).mean() - 1) < 5 * np.sqrt(2 / error.size)
    turn = [
        rotations.log(found.bones.rotation[f].transpose(0, 2, 1) @ place(body, truth[f]).rotation) for f in range(150)
    ]
    held = np.abs(turn) < 1.96 * found.bones.rotation_sd
    assert 0.92 < held.mean() < 0.98


def test_missing_markers_are_done_without_and_empty_frames_stay_empty():
    body = leg()
    truth = walking(body)
    trial = filmed(body, truth)
    points = np.array(trial.points)
    points[3, [0, 6, 9]] = np.nan
    points[10:12] = np.nan
    found = inverse_kinematics(body, None, replace(trial, points=points))
    answered = np.isfinite(found.coordinates).all(1)
    assert np.flatnonzero(~answered).tolist() == [10, 11]
    assert not found.bones.answered[10:12].any()
    assert np.abs(found.coordinates - truth)[answered].max() < 1e-7
    assert np.isnan(found.residuals[3, [0, 6, 9]]).all()


def test_a_frame_with_two_markers_has_no_estimate_and_does_not_disturb_the_next():
    body = leg()
    truth = walking(body)
    trial = filmed(body, truth)
    points = np.array(trial.points)
    points[7, 2:] = np.nan
    found = inverse_kinematics(body, None, replace(trial, points=points))
    # What is locked is known without markers.
    assert np.isnan(found.coordinates[7, body.free]).all()
    assert not found.bones.answered[7].any()
    assert np.abs(found.coordinates[8] - truth[8]).max() < 1e-7


def test_angles_are_continuous_beyond_half_a_turn_also_over_a_gap():
    body = leg()
    truth = walking(body, 40)
    turn = body.coordinate("turn")
    truth[:, turn] = np.linspace(0, 5.0, 40)
    trial = filmed(body, truth, 2e-3)
    points = np.array(trial.points)
    points[30:32] = np.nan
    found = inverse_kinematics(body, None, replace(trial, points=points))
    answered = np.isfinite(found.coordinates[:, turn])
    assert np.abs(found.coordinates - truth)[answered, turn].max() < 0.1


def test_what_no_marker_sees_is_not_invented():
    body = leg(without=("foot",))
    found = inverse_kinematics(body, None, filmed(body, walking(body)))
    ankle = body.coordinate("ankle")
    assert np.isnan(found.coordinates[:, ankle]).all()
    assert not found.determined[:, ankle].any()
    assert not found.bones.answered[:, body.body_names.index("foot")].any()
    others = np.arange(len(body.coordinates)) != ankle
    assert np.isfinite(found.coordinates[:, others]).all()


def test_one_marker_on_the_last_segment_leaves_its_turn_about_that_marker_open():
    body = leg(without=("foot", "shank", "patella", "thigh"))
    found = inverse_kinematics(body, None, filmed(body, walking(body)))
    assert np.isfinite(found.coordinates[:, :6]).all()
    for name in ("flexion", "adduction", "rotation", "knee", "patella", "ankle"):
        assert np.isnan(found.coordinates[:, body.coordinate(name)]).all()


def test_a_task_determines_what_no_marker_observes_and_this_is_reported():
    body = leg(without=("foot",))
    task = CoordinateTask(coordinate="ankle", weight=1.0, value=0.3)
    found = inverse_kinematics(body, even(body, task), filmed(body, walking(body)))
    ankle = body.coordinate("ankle")
    assert np.allclose(found.coordinates[:, ankle], 0.3)
    assert not found.determined[:, ankle].any()
    assert np.isnan(found.coordinates_sd[:, ankle]).all()
    foot = body.body_names.index("foot")
    assert found.bones.answered[:, foot].all()
    assert np.isnan(found.bones.covariance[:, foot]).all()


def test_a_task_from_a_file_takes_each_frames_value_and_weighs_against_the_mean_of_the_markers():
    body = leg(without=("foot",))
    truth = walking(body)
    wanted = np.linspace(-0.2, 0.2, len(truth))
    task = CoordinateTask(coordinate="ankle", weight=0.1, from_file=True)
    found = inverse_kinematics(body, even(body, task), filmed(body, truth), targets={"ankle": wanted})
    assert np.allclose(found.coordinates[:, body.coordinate("ankle")], wanted)
    with pytest.raises(MareyError, match="one number for each of the 30 frames"):
        inverse_kinematics(body, even(body, task), filmed(body, truth))


def test_a_clamped_coordinate_stops_at_its_limit_and_is_marked():
    body = leg(ankle_limit=0.05)
    truth = walking(body)
    ankle = body.coordinate("ankle")
    found = inverse_kinematics(body, None, filmed(body, truth))
    beyond = truth[:, ankle] > 0.05
    assert beyond.any()
    assert not beyond.all()
    assert (found.coordinates[beyond, ankle] == 0.05).all()
    assert not found.determined[beyond, ankle].any()
    assert np.abs(found.coordinates - truth)[~beyond].max() < 1e-7


def test_markers_that_are_not_used_are_listed():
    body = leg()
    tasks = TaskSet(
        markers=(
            *[MarkerTask(label=m.label, weight=1.0) for m in body.markers[1:]], MarkerTask(label="nose", weight=1.0)
        )
    )  # fmt: skip
    labels = tuple(m.label for m in body.markers[:-1])
    found = inverse_kinematics(body, tasks, filmed(body, walking(body, 3), labels=labels))
    assert found.skipped == (
        "1 markers of the tasks are missing from the model: nose",
        "1 markers of the model are missing from the trial: foot_3",
        "1 markers have no task: pelvis_0",
    )


def test_invalid_input_is_rejected():
    body = leg()
    trial = filmed(body, walking(body, 3))
    with pytest.raises(MareyError, match="has no markers"):
        inverse_kinematics(replace(body, markers=()), None, trial)
    with pytest.raises(MareyError, match="No marker is common"):
        inverse_kinematics(body, TaskSet(markers=(MarkerTask(label="nose", weight=1.0),)), trial)
    with pytest.raises(MareyError, match="no coordinate 'elbow'"):
        inverse_kinematics(body, even(body, CoordinateTask(coordinate="elbow", weight=1.0)), trial)
    with pytest.raises(MareyError, match="should be 0 or more"):
        TaskSet(markers=(MarkerTask(label="a", weight=-1.0),))
    with pytest.raises(MareyError, match="Two tasks follow the marker a"):
        TaskSet(markers=(MarkerTask(label="a", weight=1.0), MarkerTask(label="a", weight=1.0)))
