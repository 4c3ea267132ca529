from dataclasses import replace

import numpy as np
import pytest
from tests.made_scans import BALLS, made_scan

from marey.errors import MareyError
from marey.knee.markers.reference_posture import Activity, reference_posture
from marey.markers.data.trajectories import MarkerTrajectories, trajectories


def ball_places(scan, posture, segment: str) -> np.ndarray:
    """Where the balls of a bone lie in its frame, truly [mm]."""
    bone = {"thigh": "femur", "shank": "tibia"}[segment]
    rotation, origin = scan.activity.motion.bone(segment)
    at = scan.laboratory_from_scanner[bone][0]
    return (at.apply(np.array(BALLS[bone])) - origin[0] * 1e3) @ rotation[0]


def rows(posture, scan, segment: str) -> list[int]:
    labels = scan.ball_labels[:5] if segment == "thigh" else scan.ball_labels[5:]
    return [posture.labels.index(label) for label in labels]


def test_a_standing_trial_carries_the_balls_into_the_bones_frames_though_the_person_sways(rng):
    scan = made_scan(rng)
    posture = reference_posture(scan.activity, scan.standing)
    for segment, places in posture.bones.items():
        assert places.places_mm[rows(posture, scan, segment)] == pytest.approx(
            ball_places(scan, posture, segment), abs=1e-9
        )
        assert places.residual_mm < 1e-9
        assert places.sd_mm[rows(posture, scan, segment)] == pytest.approx(0.5)


def test_the_standing_trial_may_lack_markers_in_some_frames_and_one_of_the_activitys_altogether(rng):
    scan = made_scan(rng)
    points = np.array(scan.standing.points)
    points[::3, scan.standing.labels.index("thigh_1")] = np.nan
    points[:5, scan.standing.labels.index("MR2")] = np.nan
    gone = [label for label in scan.standing.labels if label != "thigh_0"]
    standing = replace(scan.standing, points=points).select(gone)
    posture = reference_posture(scan.activity, standing)
    found = posture.bones["thigh"].places_mm[rows(posture, scan, "thigh")]
    assert found == pytest.approx(ball_places(scan, posture, "thigh"), abs=1e-9)
    assert "thigh: the standing trial lacks thigh_0." in posture.notes


def test_without_a_standing_trial_the_activitys_own_reference_posture_is_taken(rng):
    scan = made_scan(rng)
    balls = np.concatenate(
        [scan.laboratory_from_scanner[bone][0].apply(np.array(BALLS[bone])) for bone in ("femur", "tibia")]
    )
    points = np.full((6, 10, 3), np.nan)
    points[0] = balls / 1e3
    seen = trajectories(
        [*scan.activity.markers.labels, *scan.ball_labels],
        np.concatenate([scan.activity.markers.points, points], 1),
        1.0,
    )
    posture = reference_posture(replace(scan.activity, markers=seen))
    for segment, places in posture.bones.items():
        assert places.cluster == ()
        assert places.places_mm[rows(posture, scan, segment)] == pytest.approx(
            ball_places(scan, posture, segment), abs=1e-9
        )


def test_the_static_trial_that_defined_the_bones_gives_these_bones_again(rng):
    # The activity's reference frame is the standing trial's first one: its bones must be reproduced.
    scan = made_scan(rng)
    own = scan.activity
    first = own.markers.points[:1]
    standing = trajectories(own.markers.labels, first, 100.0)
    posture = reference_posture(own, standing)
    for segment, places in posture.bones.items():
        rotation, origin = own.motion.bone(segment)
        assert places.laboratory_from_bone.rotation == pytest.approx(rotation[0], abs=1e-12)
        assert places.laboratory_from_bone.translation == pytest.approx(origin[0] * 1e3, abs=1e-9)


def shaken(rng, scan, mm: float) -> MarkerTrajectories:
    points = np.array(scan.standing.points)
    return replace(scan.standing, points=points + rng.normal(0, mm / 1e3, points.shape[1:]))


def test_skin_displaced_in_the_standing_trial_raises_the_standard_deviation_of_the_bone(rng):
    scan = made_scan(rng)
    still = reference_posture(scan.activity, shaken(rng, scan, 0.3)).bones["thigh"]
    moved = reference_posture(scan.activity, shaken(rng, scan, 5.0)).bones["thigh"]
    assert still.cluster_sd_mm == 0.5
    assert moved.cluster_sd_mm > 2.0
    assert moved.residual_mm > 2.0


def test_a_standing_trial_without_the_activitys_markers_is_an_error_that_names_them(rng):
    scan = made_scan(rng)
    only = scan.standing.select([*scan.ball_labels, "thigh_0", "thigh_1"])
    with pytest.raises(MareyError, match=r"thigh: the standing trial has 2 .*thigh_4.*shank: the standing trial has 0"):
        reference_posture(scan.activity, only)


def test_a_models_bones_have_no_reference_frame_and_take_the_markers_mean_place(rng):
    scan = made_scan(rng)
    activity: Activity = replace(scan.activity, reference_frames=None)
    known = scan.activity.places("thigh", ("thigh_0",))
    assert activity.places("thigh", ("thigh_0",)) == pytest.approx(known, abs=1e-12)


def test_only_the_segments_of_a_knee_are_looked_for(rng):
    scan = made_scan(rng)
    motion = replace(scan.activity.motion, segments=("pelvis", "shank"))
    activity = replace(scan.activity, motion=motion)
    assert list(reference_posture(activity, scan.standing).bones) == ["shank"]
    with pytest.raises(MareyError, match=r"no segment of a knee.*pelvis, foot"):
        reference_posture(replace(activity, motion=replace(motion, segments=("pelvis", "foot"))), scan.standing)
