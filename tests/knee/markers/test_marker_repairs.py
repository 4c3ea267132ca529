"""Balls and markers that do not correspond: the planted fault is found, and a sound knee has none."""

from dataclasses import replace

import numpy as np
import pytest
from tests.made_scans import made_scan

from marey.knee.markers.marker_repairs import (
    Correspondents,
    best_repair,
    marker_misfit,
    mirrored_scan,
    scaled,
)
from marey.knee.markers.reference_posture import reference_posture

NOISE_MM = 0.5


def correspondents(rng: np.random.Generator, *, named: bool = True) -> Correspondents:
    scan = made_scan(rng, noise_mm=NOISE_MM, named=named)
    return Correspondents(
        scanner=scan.scanner, posture=reference_posture(scan.activity, scan.standing), bones=scan.bones,
        segment_of_label=scan.activity.segment_of_label, left=None,
    )  # fmt: skip


def with_balls(given: Correspondents, centres_mm: np.ndarray) -> Correspondents:
    return replace(given, scanner=replace(given.scanner, centres_mm=centres_mm))


def with_names(given: Correspondents, names: list[str]) -> Correspondents:
    return replace(given, scanner=replace(given.scanner, names=tuple(names)))


def found(given: Correspondents) -> tuple[str, str, float]:
    """The kind of the best repair, what it changes, and its factor; its residual is that of a sound knee."""
    repair, after = best_repair(given, marker_misfit(given))
    # Ten balls with errors of 0.5 mm in each coordinate lie 0.9 mm from each other; three times this is no chance.
    assert after.residual_mm < 3 * NOISE_MM * np.sqrt(3)
    return repair.kind, repair.of, repair.factor


def test_a_sound_knee_has_no_repair(rng):
    given = correspondents(rng)
    own = marker_misfit(given)
    assert own.plausible()
    assert own.residual_mm < 3 * NOISE_MM * np.sqrt(3)
    assert best_repair(given, own) is None


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "named"), [(0.1, True), (1000.0, True), (0.001, False), (10.0, False)])
def test_a_unit_of_the_balls_is_found(rng, factor, named):
    given = correspondents(rng, named=named)
    wrong = with_balls(given, given.scanner.centres_mm * factor)
    assert found(wrong) == ("unit", "balls", pytest.approx(1 / factor))


@pytest.mark.slow
def test_a_unit_of_the_laboratory_or_of_the_whole_scan_is_found(rng):
    given = correspondents(rng)
    assert found(replace(given, posture=scaled(given.posture, 1000.0))) == ("unit", "laboratory", 0.001)
    small = with_balls(given, 0.1 * given.scanner.centres_mm)
    bones = {name: replace(bone, vertices_mm=0.1 * bone.vertices_mm) for name, bone in given.bones.items()}
    assert found(replace(small, bones=bones)) == ("unit", "scan", 10.0)


@pytest.mark.slow
@pytest.mark.parametrize("named", [True, False])
def test_a_mirror_image_is_found(rng, named):
    given = correspondents(rng, named=named)
    if not named:
        assert found(mirrored_scan(given))[0] == "mirrored"
    assert found(with_balls(given, given.scanner.centres_mm * [1, -1, 1]))[0] == "mirrored"


@pytest.mark.slow
def test_axes_of_another_program_are_found_where_the_balls_leave_the_bones(rng):
    given = correspondents(rng)
    away = np.array([0.0, 120.0, 0.0])
    bones = {name: replace(bone, vertices_mm=bone.vertices_mm + away) for name, bone in given.bones.items()}
    there = replace(with_balls(given, given.scanner.centres_mm + away), bones=bones)
    assert best_repair(there, marker_misfit(there)) is None
    wrong = with_balls(there, there.scanner.centres_mm * [-1, -1, 1])
    repair, after = best_repair(wrong, marker_misfit(wrong))
    assert repair.kind == "axes"
    assert after.from_bones_mm < 0.5 * marker_misfit(wrong).from_bones_mm


@pytest.mark.slow
def test_exchanged_names_are_found(rng):
    given = correspondents(rng)
    names = list(given.scanner.names)
    # One wrong ball of five is left out by the fit, on each bone; both fit when the names are exchanged back.
    names[2], names[7] = names[7], names[2]
    wrong = with_names(given, names)
    own = marker_misfit(wrong)
    assert own.residual_mm < 3 * NOISE_MM * np.sqrt(3) < 10 < own.every_mm
    repair, after = best_repair(wrong, own)
    assert (repair.kind, set(repair.names)) == ("names", {names[2], names[7]})
    assert after.every_mm < 3 * NOISE_MM * np.sqrt(3)
    # A second pair cannot be left out, and one exchange does not explain both.
    names[0], names[1] = names[1], names[0]
    assert best_repair(with_names(given, names), marker_misfit(with_names(given, names))) is None


@pytest.mark.slow
def test_a_ball_that_was_put_back_elsewhere_is_not_taken_for_an_exchanged_name(rng):
    given = correspondents(rng)
    centres = given.scanner.centres_mm.copy()
    centres[3] += [15.0, -10.0, 10.0]
    own = marker_misfit(with_balls(given, centres))
    assert own.every_mm > 4.0
    assert best_repair(with_balls(given, centres), own) is None


def test_exchanged_names_of_three_balls_are_found(rng):
    given = correspondents(rng)
    three = [0, 1, 2, 5, 6, 7]
    scanner = given.scanner
    few = replace(
        scanner, centres_mm=scanner.centres_mm[three], sd_mm=scanner.sd_mm[three],
        names=tuple(scanner.names[n] for n in (1, 0, 2, 5, 6, 7)), bones=tuple(scanner.bones[n] for n in three),
    )  # fmt: skip
    repair, _ = best_repair(replace(given, scanner=few), marker_misfit(replace(given, scanner=few)))
    assert (repair.kind, set(repair.names)) == ("names", {"MR0", "MR1"})


@pytest.mark.slow
def test_names_of_the_other_leg_are_found(rng):
    given = correspondents(rng)
    own = [name.replace("MR", "left_") for name in given.scanner.names]
    rest = [label.replace("MR", "left_") for label in given.posture.labels]
    other = [label.replace("left_", "right_") for label in rest if label.startswith("left_")]
    # The other leg's balls lie elsewhere.
    more = {
        segment: replace(
            each, places_mm=np.concatenate([each.places_mm, rng.uniform(-60, 60, (len(other), 3)) + [0, 0, 300]]),
            sd_mm=np.concatenate([each.sd_mm, np.full((len(other), 3), 0.5)]),
        )
        for segment, each in given.posture.bones.items()
    }  # fmt: skip
    both = replace(given, posture=replace(given.posture, labels=(*rest, *other), bones=more))
    assert best_repair(with_names(both, own), marker_misfit(with_names(both, own))) is None
    assert found(with_names(both, [name.replace("left", "right") for name in own])) == ("sides", "balls", 1.0)


@pytest.mark.slow
def test_names_in_another_order_have_no_repair_but_are_no_knee(rng):
    given = correspondents(rng)
    wrong = with_names(given, list(rng.permutation(given.scanner.names)))
    own = marker_misfit(wrong)
    assert own.residual_mm > 15.0
    assert best_repair(wrong, own) is None
