"""A knee that is turned round in the laboratory bends forwards, or its bones point away from their markers."""

from dataclasses import replace

import numpy as np
import pytest
from tests.knee.markers.test_anatomical_frames import made_femur
from tests.made_scans import CLUSTERS, MadeScan, made_scan

from marey.knee.markers.bend_checks import bends_of
from marey.knee.markers.marker_repairs import Correspondents, best_repair, marker_misfit
from marey.knee.markers.reference_posture import reference_posture

FEMUR = made_femur(60.0)
BENT = np.array([5.0, 10, 20, 40, 50, 30])
"""Angles of the made activity [degrees]."""


@pytest.fixture
def scan(rng: np.random.Generator) -> MadeScan:
    return made_scan(rng, noise_mm=0.3)


def correspondents(scan: MadeScan, signs: tuple[int, int, int] = (1, 1, 1), *, bends: bool = True) -> Correspondents:
    posture = reference_posture(scan.activity, scan.standing)
    scanner = replace(scan.scanner, centres_mm=scan.scanner.centres_mm * np.array(signs))
    given = Correspondents(
        scanner=scanner, posture=posture, bones=scan.bones | {"femur": FEMUR},
        segment_of_label=scan.activity.segment_of_label, left=None,
    )  # fmt: skip
    return replace(given, bends=bends_of(scan.activity, posture, left=None)) if bends else given


def test_the_bend_is_that_of_the_activity_whatever_the_frames_of_the_segments_are(scan):
    own = marker_misfit(correspondents(scan))
    # The axis of the made bend is 6 degrees from the lateral one, and noise turns a bone by less than 1 degree.
    assert np.degrees(own.forward) == pytest.approx(np.quantile(-BENT, 0.95), abs=1.5)
    assert not own.turned_round()
    # The middle of the made knee lies within 30 mm of the origin.
    assert own.beyond_mm == pytest.approx(-np.mean(CLUSTERS["tibia"], 0)[2], abs=30.0)


@pytest.mark.slow
def test_signs_of_x_and_y_make_the_knee_bend_forwards_and_are_found(scan):
    wrong = correspondents(scan, (-1, -1, 1))
    own = marker_misfit(wrong)
    assert np.degrees(own.forward) == pytest.approx(np.quantile(BENT, 0.95), abs=1.5)
    repair, after = best_repair(wrong, own)
    assert (repair.kind, repair.names) == ("axes", ("x", "y"))
    assert after.forward < 0


@pytest.mark.slow
def test_signs_of_y_and_z_turn_the_bones_away_from_their_markers_and_are_found(scan):
    wrong = correspondents(scan, (1, -1, -1))
    own = marker_misfit(wrong)
    assert own.beyond_mm < -100.0
    repair, after = best_repair(wrong, own)
    assert (repair.kind, repair.names) == ("axes", ("y", "z"))
    assert after.beyond_mm > 100.0


def test_without_a_bend_the_signs_of_x_and_y_cannot_be_known(scan):
    wrong = correspondents(scan, (-1, -1, 1), bends=False)
    assert np.isnan(marker_misfit(wrong).forward)
    assert best_repair(wrong, marker_misfit(wrong)) is None


def test_an_activity_without_the_tibia_has_no_bends(scan):
    posture = reference_posture(scan.activity, scan.standing)
    alone = replace(posture, bones={name: at for name, at in posture.bones.items() if name == "thigh"})
    assert bends_of(scan.activity, alone, left=None).shape == (0, 3, 3)
