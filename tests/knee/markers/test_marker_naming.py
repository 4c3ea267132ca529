from dataclasses import replace

import numpy as np
import pytest
from tests.made_scans import MadeScan, made_scan

from marey.errors import MareyError
from marey.knee.markers.marker_bones import bone_of_label, bone_of_segment
from marey.knee.markers.marker_matching import MarkerMatchingSettings
from marey.knee.markers.marker_naming import (
    MarkerNamingSettings,
    NamedBalls,
    ScannerMarkers,
    named_balls,
    segment_of_bone,
)
from marey.knee.markers.reference_posture import reference_posture


def named(scan: MadeScan, scanner: ScannerMarkers) -> NamedBalls:
    posture = reference_posture(scan.activity, scan.standing)
    return named_balls(
        scanner, posture, scan.bones, segment_of_label=scan.activity.segment_of_label, left=None
    )  # fmt: skip


def test_unnamed_balls_get_their_names_and_bones_by_distance_and_place(rng):
    scan = made_scan(rng, noise_mm=0.4, named=False)
    found = named(scan, replace(scan.scanner, bones=()))
    assert list(found.labels) == scan.ball_labels
    assert found.bones == ("femur",) * 5 + ("tibia",) * 5
    assert any("the nearer of femur and tibia is used" in note for note in found.notes)


def test_some_names_given_are_kept_and_the_others_found(rng):
    scan = made_scan(rng)
    names = ("MR0", None, "MR2", *[None] * 7)
    assert list(named(scan, replace(scan.scanner, names=names)).labels) == scan.ball_labels


def test_the_label_in_the_activity_determines_the_bone_before_the_position(rng):
    scan = made_scan(rng, named=True, balls_are_clusters=True)
    found = named(scan, replace(scan.scanner, bones=()))
    assert found.bones == ("femur",) * 5 + ("tibia",) * 5
    assert not any("the nearer of femur and tibia is used" in note for note in found.notes)


def test_a_ball_nearer_to_the_wrong_bone_is_assigned_to_the_bone_whose_motion_it_shares(rng):
    scan = made_scan(rng, named=False)
    tibia = scan.bones["tibia"]
    # Ball 3, the lowest of the femur's, is nearer to a tibia that reaches so high.
    high = replace(tibia, vertices_mm=tibia.vertices_mm + [0, 0, 40.0])
    found = named(replace(scan, bones={**scan.bones, "tibia": high}), replace(scan.scanner, bones=()))
    assert list(found.labels) == scan.ball_labels
    assert found.bones == ("femur",) * 5 + ("tibia",) * 5
    assert any("marker 3 fits MR3 if it is on the femur" in note for note in found.notes)
    assert any("About equally near to both bones: markers 0, 3" in note for note in found.notes)


def test_a_too_regular_arrangement_of_balls_is_an_error_that_names_them(rng):
    scan = made_scan(rng, named=False)
    posture = reference_posture(scan.activity, scan.standing)
    thigh = posture.bones["thigh"]
    places = np.array(thigh.places_mm)
    rows = [posture.labels.index(label) for label in scan.ball_labels[:5]]
    square = np.array([[0.0, 0, 0], [50, 0, 0], [50, 50, 0], [0, 50, 0]])
    places[rows[:4]], places[rows[4]] = square, np.nan
    regular = replace(posture, bones={**posture.bones, "thigh": replace(thigh, places_mm=places)})
    centres = np.array(scan.scanner.centres_mm)
    centres[:4] = square
    scanner = ScannerMarkers(centres_mm=centres[:4], sd_mm=scan.scanner.sd_mm[:4], bones=("femur",) * 4)
    with pytest.raises(MareyError, match=r"markers 0, 1, 2, 3 of the femur.*marker_names"):
        named_balls(scanner, regular, scan.bones, segment_of_label={}, left=None)


def test_balls_that_fit_by_chance_among_very_many_markers_are_not_matched(rng):
    scan = made_scan(rng, named=False)
    posture = reference_posture(scan.activity, scan.standing)
    # Three balls of one bone, among 200 other markers in half a metre.
    others = rng.uniform(-250, 250, (200, 3))
    thigh = posture.bones["thigh"]
    rows = [posture.labels.index(label) for label in scan.ball_labels[:3]]
    many = replace(
        posture, labels=tuple(f"M{n}_a" for n in range(203)),
        bones={"thigh": replace(thigh, places_mm=np.concatenate([thigh.places_mm[rows], others]),
                                sd_mm=np.full((203, 3), 0.5))},
    )  # fmt: skip
    scanner = ScannerMarkers(centres_mm=scan.scanner.centres_mm[:3], sd_mm=np.full((3, 3), 0.1), bones=("femur",) * 3)
    with pytest.raises(MareyError, match=r"in more than one way|by chance"):
        named_balls(scanner, many, scan.bones, segment_of_label={}, left=None)


def test_the_settings_of_the_matching_reach_the_names(rng):
    scan = made_scan(rng, named=False)
    posture = reference_posture(scan.activity, scan.standing)
    for settings, why in (
        (MarkerNamingSettings(matching=MarkerMatchingSettings(most_matches=0)), "too many markers"),
        (MarkerNamingSettings(most_by_chance=-1.0), "by chance"),
    ):
        with pytest.raises(MareyError, match=why):
            named_balls(scan.scanner, posture, scan.bones, segment_of_label={}, left=None, settings=settings)


def test_a_marker_that_rides_elsewhere_in_the_activity_is_no_ball_of_this_bone(rng):
    scan = made_scan(rng, named=False)
    posture = reference_posture(scan.activity, scan.standing)
    segments = {**scan.activity.segment_of_label, "MR2": "pelvis"}
    found = named_balls(scan.scanner, posture, scan.bones, segment_of_label=segments, left=None)
    assert list(found.labels) == ["MR0", "MR1", None, *scan.ball_labels[3:]]
    assert any("femur: marker 2 ignored, because the reference has no marker" in note for note in found.notes)


def test_segments_are_bones_of_the_knee_that_was_scanned():
    assert bone_of_segment("left_thigh", left=True) == "femur"
    assert bone_of_segment("right_thigh", left=True) is None
    assert bone_of_segment("shank", left=True) == "tibia"
    assert bone_of_segment("pelvis") is None
    assert bone_of_segment("femur_r", left=False) == "femur"
    assert bone_of_segment("tibia_l", left=False) is None
    assert bone_of_label("right_shank_3", {}, left=False) == "tibia"
    assert bone_of_label("LT1", {"LT1": "left_shank"}, left=True) == "tibia"
    assert segment_of_bone("femur", ["pelvis", "left_thigh", "right_thigh"], left=False) == "right_thigh"
    with pytest.raises(MareyError, match="--side"):
        segment_of_bone("femur", ["left_thigh", "right_thigh"], left=None)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"names": ("A", "A", "B")}, "have the name A"),
        ({"bones": ("femur", "hip", None)}, "on hip"),
        ({"names": ("A",)}, "do not fit"),
    ],
)
def test_impossible_entries_for_the_balls_are_errors(given, message):
    with pytest.raises(MareyError, match=message):
        ScannerMarkers(centres_mm=np.zeros((3, 3)), sd_mm=np.ones((3, 3)), **given)
