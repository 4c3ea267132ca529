from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from tests.made_scans import MadeScan, made_scan

from marey.errors import MareyError
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.knee.markers.correspondence import (
    KneeCorrespondence,
    bone_chain,
    correspond,
    mean_error_quantile,
)
from marey.knee.markers.reference_posture import reference_posture
from marey.markers.kinematics.transform_chain import CAPTURE_GLOBAL, MR_GLOBAL, NamedTransform


def joined(scan: MadeScan, *, noise_mm: float = 0.5) -> KneeCorrespondence:
    posture = reference_posture(scan.activity, scan.standing, noise_mm=noise_mm)
    return correspond(scan.scanner, posture, scan.bones, segment_of_label=scan.activity.segment_of_label)


def off(transform: NamedTransform, true: RigidTransform) -> np.ndarray:
    """The error of a transform in the order of its covariance: rotation [rad], then translation [mm]."""
    turn = rotations.log(transform.rotation.T @ true.rotation)
    return np.concatenate([turn, true.translation - transform.translation])


@pytest.mark.parametrize("named", [True, False])
def test_exact_markers_close_the_chain_from_the_scanner_to_the_moving_bone(rng, named):
    scan = made_scan(rng, named=named)
    found = joined(scan)
    for bone, truth in scan.laboratory_from_scanner.items():
        chain = bone_chain(found.bones[bone], scan.activity.motion)
        whole = chain.between(CAPTURE_GLOBAL, MR_GLOBAL)
        vertices = scan.bones[bone].vertices_mm
        right = np.stack([at.apply(vertices) for at in truth])
        assert np.abs(whole.apply(vertices) - right).max() < 1e-8
        assert found.bones[bone].fit.residual_mm < 1e-8
        assert found.bones[bone].posture_residual_mm < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("balls_are_clusters", [False, True])
def test_the_stated_covariance_is_that_of_random_draws(rng, balls_are_clusters):
    distances = {"femur": [], "tibia": []}
    for _ in range(80):
        scan = made_scan(rng, noise_mm=0.5, balls_are_clusters=balls_are_clusters)
        found = joined(scan)
        for bone, truth in scan.laboratory_from_scanner.items():
            chain = bone_chain(found.bones[bone], scan.activity.motion)
            # The activity is exact, so that the first frame's bone shows the error of the first two steps alone.
            error = off(chain.between(CAPTURE_GLOBAL, MR_GLOBAL).at(0), truth[0])
            covariance = chain.between(CAPTURE_GLOBAL, MR_GLOBAL).at(0).covariance
            distances[bone].append(error @ np.linalg.solve(covariance, error))
    for squared in distances.values():
        # Six degrees of freedom, variance 12; raised covariances of some draws make the mean slightly smaller.
        assert np.mean(squared) == pytest.approx(6.0, abs=4 * np.sqrt(12 / 80) + 0.3)
        assert 0.86 < np.mean(np.array(squared) < chi2.ppf(0.95, 6)) <= 1.0


def test_the_quantile_of_the_mean_error_is_that_of_drawn_transforms(rng):
    root = np.diag([0.01, 0.02, 0.005, 0.5, 0.3, 0.4]) @ rng.normal(size=(6, 6))
    transform = NamedTransform(
        to="b", from_="a", rotation=rotations.exp(rng.normal(size=3)), translation=rng.normal(size=3),
        covariance=root @ root.T,
    )  # fmt: skip
    points = rng.normal(0, 40, (5, 3))
    draws = rng.normal(size=(20000, 6)) @ root.T
    turned = transform.rotation @ rotations.exp(draws[:, :3])
    moved = points @ np.swapaxes(turned, 1, 2) + (transform.translation + draws[:, 3:])[:, None]
    errors = moved - transform.apply(points)
    within = np.linalg.norm(errors, axis=-1).mean(1)
    assert mean_error_quantile(transform, points) == pytest.approx(np.quantile(within, 0.95), rel=0.1)


def test_a_bone_with_two_common_markers_is_reported_and_the_other_one_is_transformed(rng):
    scan = made_scan(rng)
    fewer = [*range(5), 5, 6]
    lost = replace(
        scan.scanner, centres_mm=scan.scanner.centres_mm[fewer], sd_mm=scan.scanner.sd_mm[fewer],
        names=scan.scanner.names[:7], bones=scan.scanner.bones[:7],
    )  # fmt: skip
    found = joined(replace(scan, scanner=lost))
    assert set(found.bones) == {"femur"}
    assert "2 markers in common" in found.missing["tibia"]


def test_named_markers_that_the_reference_never_shows_are_not_used(rng):
    scan = made_scan(rng)
    points = np.array(scan.standing.points)
    for label in ("MR1", "MR5", "MR7", "MR8"):
        points[:, scan.standing.labels.index(label)] = np.nan
    found = joined(replace(scan, standing=replace(scan.standing, points=points)))
    assert found.bones["femur"].fit.names == ("MR0", "MR2", "MR3", "MR4")
    assert any("not used: MR1" in note for note in found.bones["femur"].notes)
    assert found.missing["tibia"].startswith(
        "it has 2 markers in common with the reference (MR5, MR7, MR8: not visible in any frame of the reference)"
    )


def test_a_patella_that_is_tracked_but_carries_no_ball_is_reported(rng):
    scan = made_scan(rng)
    posture = reference_posture(scan.activity, scan.standing)
    with_patella = replace(posture, bones={**posture.bones, "patella": posture.bones["thigh"]})
    bones = {**scan.bones, "patella": scan.bones["femur"]}
    found = correspond(scan.scanner, with_patella, bones, segment_of_label={})
    assert found.missing == {"patella": "it has 0 markers in common with the reference, but needs 3"}


def test_markers_that_are_not_in_the_reference_are_named(rng):
    scan = made_scan(rng)
    wrong = replace(scan.scanner, names=("ball", *scan.scanner.names[1:]))
    with pytest.raises(MareyError, match=r"names ball, missing from the reference.*MR1"):
        joined(replace(scan, scanner=wrong))


def test_an_activity_without_the_knees_segments_is_an_error_that_names_the_bones(rng):
    scan = made_scan(rng)
    posture = reference_posture(scan.activity, scan.standing)
    only = replace(posture, bones={"foot": posture.bones["thigh"]})
    with pytest.raises(MareyError, match=r"femur: no segment of the activity.*tibia"):
        correspond(scan.scanner, only, scan.bones, segment_of_label={})


def test_a_reference_without_the_balls_is_an_error_that_names_the_cause(rng):
    scan = made_scan(rng, named=False)
    without = [label for label in scan.standing.labels if not label.startswith("MR")]
    with pytest.raises(MareyError, match=r"No three of the scanner's markers.*Check that the reference shows them"):
        joined(replace(scan, standing=scan.standing.select(without)))
