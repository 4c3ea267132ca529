import numpy as np
import pytest
from tests.made_joints import RADIUS_MM, made_joint

from marey.errors import MareyError
from marey.geometry import rotations
from marey.knee.motion.joint_surface import JointSurface, joint_surface
from marey.knee.motion.proximity import RelativePoses, proximity

COVARIANCE = np.diag([0.01, 0.02, 0.015, 0.3, 0.2, 0.4]) ** 2


@pytest.fixture(scope="module")
def sides() -> tuple[JointSurface, JointSurface]:
    parts = made_joint(gap_mm=1.0, fine=4)
    return (
        joint_surface("tibial_cartilage", parts["tibial_cartilage"], parts["tibia"], left=False),
        joint_surface("femoral_cartilage", parts["femoral_cartilage"], parts["femur"], left=False),
    )


def poses(*shifts: tuple[float, float, float], turn: tuple[float, float, float] = (0, 0, 0)) -> RelativePoses:
    count = len(shifts)
    return RelativePoses(
        rotation=np.repeat(rotations.exp(np.array(turn, float))[None], count, 0),
        translation_mm=np.array(shifts, float),
        covariance=np.repeat(COVARIANCE[None], count, 0),
    )  # fmt: skip


def perturbed(at: RelativePoses, axis: int, step: float) -> RelativePoses:
    error = step * np.eye(6)[axis]
    return RelativePoses(
        rotation=at.rotation @ rotations.exp(error[:3]), translation_mm=at.translation_mm + error[3:],
        covariance=at.covariance,
    )  # fmt: skip


def test_the_gap_of_a_ball_over_a_plane_is_its_height(sides):
    # A tibial vertex lies at most h / sqrt(2) beside the lowest place, h = 1.25 mm: there the ball is higher by less
    # than 0.02 mm; and its facets, with sides of 1.5 mm, lie up to 0.02 mm within.
    found = proximity("tibiofemoral", *sides, poses((0, 0, 0), (0, 0, 2.5), (0, 0, -1.5), (0.3, -4.2, 0)))
    assert found.compartments == ("medial", "lateral")
    np.testing.assert_allclose(found.gap_mm, np.repeat([[1.0], [3.5], [-0.5], [1.0]], 2, 1), atol=0.04)


def test_areas_are_those_of_the_ball_s_neighbourhood(sides):
    found = proximity("tibiofemoral", *sides, poses((0, 0, -2)))
    height = RADIUS_MM - 1
    for area, limit in ((found.overlap_mm2, 0.0), (found.close_mm2, 3.0), (found.near_mm2, 5.0)):
        wanted = np.pi * ((RADIUS_MM + limit) ** 2 - height**2)
        # A vertex represents 1.3 mm2; 0.02 mm in height correspond to 2.5 mm2.
        np.testing.assert_allclose(area[0], wanted, rtol=0.03, atol=6.0)


def test_the_centres_are_below_the_ball_s_middle_on_both_surfaces(sides):
    found = proximity("tibiofemoral", *sides, poses((0, 5, 0), turn=(0.2, 0, 0)))
    middle = rotations.exp(np.array([0.2, 0, 0])) @ np.array([0, 0, RADIUS_MM + 1]) + (0, 5, 0)
    np.testing.assert_allclose(found.centre_mm[0], [[22, middle[1], 0], [-22, middle[1], 0]], atol=0.15)
    below = rotations.exp(np.array([-0.2, 0, 0])) @ np.array([0, 0, -RADIUS_MM]) + (0, 0, RADIUS_MM + 1)
    np.testing.assert_allclose(found.moving_centre_mm[0], [[22, *below[1:]], [-22, *below[1:]]], atol=0.25)


def test_the_gap_s_deviation_is_that_of_differences(sides):
    at = poses((0.4, 1.3, 0.7), turn=(0.1, 0.05, -0.08))
    found = proximity("tibiofemoral", *sides, at)
    slopes = []
    for axis in range(6):
        ahead, behind = (proximity("", *sides, perturbed(at, axis, sign * 1e-4)).gap_mm[0] for sign in (1, -1))
        slopes.append((ahead - behind) / 2e-4)
    wanted = np.sqrt(np.einsum("ac,ab,bc->c", slopes, COVARIANCE, slopes))
    np.testing.assert_allclose(found.gap_sd_mm[0], wanted, rtol=0.01)


def test_the_centres_deviations_are_those_of_differences(sides):
    at = poses((0.4, 1.3, 0.7), turn=(0.1, 0.05, -0.08))
    found = proximity("tibiofemoral", *sides, at)
    for name in ("centre", "moving_centre"):
        slopes = []
        for axis in range(6):
            step = 1e-4
            ends = [proximity("", *sides, perturbed(at, axis, sign * step)) for sign in (1, -1)]
            ahead, behind = (getattr(end, f"{name}_mm")[0] for end in ends)
            slopes.append((ahead - behind) / (2 * step))
        wanted = np.sqrt(np.einsum("aci,ab,bci->ci", slopes, COVARIANCE, slopes))
        # Along the surface; across it the centre is put back onto it, and the deviation before that is smaller.
        np.testing.assert_allclose(getattr(found, f"{name}_sd_mm")[0, :, :2], wanted[:, :2], rtol=0.02)


def test_nothing_changes_when_the_room_turns_about_both(sides):
    base, moving = sides
    at = poses((0, 1, -0.5), turn=(0.1, 0, 0.03))
    plain = proximity("", base, moving, at)
    turn, shift = rotations.exp(np.array([0.4, -0.2, 0.7])), np.array([3.0, 9, -4])
    parts = made_joint(gap_mm=1.0)
    moved = {name: type(s)(vertices_mm=s.vertices_mm @ turn.T + shift, faces=s.faces) for name, s in parts.items()}
    carried = joint_surface("femoral_cartilage", moved["femoral_cartilage"], moved["femur"], left=False)
    back = RelativePoses(
        rotation=at.rotation @ turn.T, translation_mm=at.translation_mm - at.rotation @ turn.T @ shift,
        covariance=at.covariance,
    )  # fmt: skip
    again = proximity("", base, carried, back)
    np.testing.assert_allclose(again.gap_mm, plain.gap_mm, atol=1e-9)
    np.testing.assert_allclose(again.centre_mm, plain.centre_mm, atol=1e-6)
    np.testing.assert_allclose(again.moving_centre_mm, plain.moving_centre_mm @ turn.T + shift, atol=1e-6)


def test_frames_without_a_pose_stay_empty(sides):
    shifts = [(0.0, 0, 0), (np.nan,) * 3, (0, 0, 9)]
    found = proximity("tibiofemoral", *sides, poses(*shifts))
    for values in (found.gap_mm, found.base_distance_mm, found.near_mm2, found.centre_mm):
        assert np.isnan(values[1]).all()
    # Too far to have a centre, but not without a gap.
    assert np.isnan(found.centre_mm[2]).all()
    assert np.isfinite(found.gap_mm[2]).all()
    assert (found.near_mm2[2] == 0).all()


def test_a_gap_below_its_standard_deviation_is_flagged(sides):
    found = proximity("tibiofemoral", *sides, poses((0, 0, -0.9), (0, 0, 3)))
    np.testing.assert_array_equal(found.unsure, [[True, True], [False, False]])


def test_without_covariance_there_is_no_deviation(sides):
    at = poses((0, 0, 0))
    found = proximity("", *sides, RelativePoses(rotation=at.rotation, translation_mm=at.translation_mm))
    assert np.isnan(found.gap_sd_mm).all()
    assert np.isfinite(found.gap_mm).all()
    assert not found.unsure.any()


def test_a_knee_of_unknown_side_is_measured_as_a_whole():
    parts = made_joint()
    base = joint_surface("tibial_cartilage", parts["tibial_cartilage"], parts["tibia"], left=None)
    moving = joint_surface("femoral_cartilage", parts["femoral_cartilage"], parts["femur"], left=None)
    found = proximity("tibiofemoral", base, moving, poses((0, 0, 0)))
    assert found.compartments == ("all",)
    np.testing.assert_allclose(found.gap_mm, [[1.0]], atol=0.04)


def test_a_limit_of_nothing_is_an_error(sides):
    with pytest.raises(MareyError, match="limit"):
        proximity("", *sides, poses((0, 0, 0)), limit_mm=0.0)
