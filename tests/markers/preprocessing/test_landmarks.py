"""A person who stands along the axes (X ahead, Y up, Z right) gives frames whose rotation is the identity."""

import numpy as np
import pytest

from marey.geometry import rotations
from marey.markers.data.clusters import Cluster
from marey.markers.data.trajectories import trajectories
from marey.markers.preprocessing.landmarks import anatomical_frames, static_bones
from marey.markers.preprocessing.own_frames import transfer_calibration

LIMB = {
    "HJC": (0, 0.9, 0.1), "ME": (0, 0.5, 0.05), "LE": (0, 0.5, 0.15), "MC": (0, 0.45, 0.06), "LC": (0, 0.45, 0.14),
    "MM": (0, 0.1, 0.06), "LM": (0, 0.1, 0.14), "CA": (-0.05, 0.03, 0.1), "M1": (0.15, 0.03, 0.06),
    "M5": (0.15, 0.03, 0.14), "GH": (0, 1.4, 0.2), "EM": (0, 1.1, 0.17), "EL": (0, 1.1, 0.23), "US": (0, 0.85, 0.2),
    "RS": (0, 0.85, 0.25),
}  # fmt: skip
TRUNK = {
    "RASIS": (0.1, 1, 0.12), "LASIS": (0.1, 1, -0.12), "RPSIS": (-0.1, 1, 0.05), "LPSIS": (-0.1, 1, -0.05),
    "IJ": (0.08, 1.4, 0), "PX": (0.08, 1.2, 0), "C7": (-0.08, 1.4, 0), "T8": (-0.08, 1.2, 0),
}  # fmt: skip
PERSON = {name: np.array(at, float) for name, at in TRUNK.items()} | {
    f"{side}_{name}": np.array([x, y, sign * z]) for side, sign in (("right", 1), ("left", -1))
    for name, (x, y, z) in LIMB.items()
}  # fmt: skip
KINDS = ("thigh", "shank", "foot", "upperarm", "forearm")
SEGMENTS = ("pelvis", "thorax", *(f"{side}_{kind}" for side in ("left", "right") for kind in KINDS))


def test_a_person_along_the_axes_has_frames_along_them_on_both_sides():
    found = anatomical_frames(PERSON, SEGMENTS, landmark_sd_m=0.01)
    assert [frame.segment for frame in found.frames] == list(SEGMENTS)
    assert found.notes == ()
    for frame in found.frames:
        if "forearm" in frame.segment:
            continue  # its Y goes to the ulnar styloid, its Z to the radial one: turned by the styloids' offset
        np.testing.assert_allclose(frame.rotation, np.eye(3), atol=1e-12, err_msg=frame.segment)


@pytest.mark.parametrize("segment", SEGMENTS)
def test_a_frame_turns_and_moves_with_its_landmarks(rng, segment: str):
    turn, shift = rotations.exp(rng.normal(size=3)), rng.normal(size=3)
    (still,) = anatomical_frames(PERSON, [segment], landmark_sd_m=0.01).frames
    moved = {name: turn @ at + shift for name, at in PERSON.items()}
    (frame,) = anatomical_frames(moved, [segment], landmark_sd_m=0.01).frames
    np.testing.assert_allclose(frame.rotation, turn @ still.rotation, atol=1e-12)
    np.testing.assert_allclose(frame.origin, turn @ still.origin + shift, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("segment", ["pelvis", "left_thigh", "right_shank"])
def test_the_covariance_is_the_spread_over_palpations(rng, segment: str):
    sd = 0.002
    (frame,) = anatomical_frames(PERSON, [segment], landmark_sd_m=sd).frames
    errors = []
    for _ in range(150):
        palpated = {name: at + sd * rng.normal(size=3) for name, at in PERSON.items()}
        (other,) = anatomical_frames(palpated, [segment], landmark_sd_m=sd).frames
        errors.append([*rotations.log(frame.rotation.T @ other.rotation), *(other.origin - frame.origin)])
    spread = np.std(errors, axis=0)
    np.testing.assert_allclose(np.sqrt(np.diag(frame.covariance)), spread, rtol=0.25)  # 4 / sqrt(2 * 150)


def test_what_is_missing_is_reported():
    found = anatomical_frames({"HJC": np.zeros(3)}, ["thigh", "hand"], landmark_sd_m=0.01)
    assert found.frames == ()
    assert "without the landmarks ME, LE" in found.notes[0]
    assert "hand: no anatomical frame is known" in found.notes[1]
    limb = {name: PERSON[f"left_{name}"] for name in LIMB}
    assert "left or the right" in anatomical_frames(limb, ["femur"], landmark_sd_m=0.01).notes[0]
    (frame,) = anatomical_frames(limb, ["femur"], landmark_sd_m=0.01, side="left").frames
    np.testing.assert_allclose(frame.rotation, np.eye(3), atol=1e-12)


def test_the_replacement_of_a_landmark_is_reported():
    few = {name: at for name, at in PERSON.items() if name[-2:] not in ("MC", "LC", "CA", "M1", "M5")}
    found = anatomical_frames(few, ["right_shank", "right_foot"], landmark_sd_m=0.01)
    assert len(found.frames) == 2
    assert "epicondyles" in found.notes[0]
    assert any("shank's frame" in note for note in found.notes)


def test_bones_of_a_static_trial_are_transferred_into_another(rng):
    cluster = Cluster(segment="left_thigh", labels=("a", "b", "c", "d"))
    on_thigh = rng.uniform(-0.1, 0.1, (4, 3)) + [0, 0.7, -0.1]
    names = ["left_HJC", "left_ME", "left_LE"]
    static = trajectories(
        (*cluster.labels, *names), np.broadcast_to([*on_thigh, *(PERSON[n] for n in names)], (5, 7, 3)), 100.0
    )
    bones, found = static_bones(static, [cluster], {n: (n,) for n in names}, landmark_sd_m=0.01)
    turns = [rotations.exp(v) for v in rng.normal(size=(6, 3))]
    walk = trajectories(cluster.labels, np.stack([on_thigh @ turn.T for turn in turns]), 100.0)
    calibration = transfer_calibration(bones, walk, [cluster]).calibration
    turn = turns[int(calibration.frames[0])]
    np.testing.assert_allclose(calibration.rotation[0, 0], turn, atol=1e-9)
    np.testing.assert_allclose(calibration.origin[0, 0], turn @ PERSON["left_HJC"], atol=1e-9)
    assert found.notes == ()
