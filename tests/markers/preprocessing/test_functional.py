import numpy as np
import pytest

from marey.errors import MareyError
from marey.geometry import rotations
from marey.markers.preprocessing.functional import sara, score, sphere_centre, transfer_point

CENTRE = np.array([0.05, -0.08, 0.1])


def joint_motion(rng, turns: np.ndarray, noise_m: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Markers of a parent and a child (F, 4, 3) that turn about a common centre, and the centre (F, 3)."""
    frames = len(turns)
    shapes = rng.uniform(-0.15, 0.15, (2, 4, 3)) + np.array([[[0, 0, 0.2]], [[0, 0, -0.2]]])
    moving = np.stack([rotations.exp(v) for v in 0.3 * np.cumsum(rng.normal(size=(frames, 3)), 0) / np.sqrt(frames)])
    place = np.cumsum(rng.normal(size=(frames, 3)), 0) * 0.01
    child_turn = moving @ np.stack([rotations.exp(v) for v in turns])
    parent = np.einsum("fij,mj->fmi", moving, shapes[0] - CENTRE)
    child = np.einsum("fij,mj->fmi", child_turn, shapes[1])
    points = [p + place[:, None] + noise_m * rng.normal(size=p.shape) for p in (parent, child)]
    return points[0], points[1], place


def star(frames: int = 200) -> np.ndarray:
    time = np.linspace(0, 1, frames)
    swing = [0.5 * np.sin(6 * np.pi * time), 0.4 * np.sin(10 * np.pi * time), 0.2 * np.cos(4 * np.pi * time)]
    return np.stack(swing, -1)


@pytest.mark.parametrize("find", [score, sphere_centre])
def test_the_centre_of_a_ball_joint_is_found_and_transferred(rng, find):
    parent, child, place = joint_motion(rng, star())
    centre = find(parent, child)
    np.testing.assert_allclose(transfer_point(centre.parent_shape, centre.in_parent, parent), place, atol=1e-8)
    assert centre.residual < 1e-9


def test_score_gives_the_centre_in_the_child_too(rng):
    parent, child, place = joint_motion(rng, star())
    centre = score(parent, child)
    np.testing.assert_allclose(transfer_point(centre.child_shape, centre.in_child, child), place, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("find", [score, sphere_centre])
def test_the_stated_standard_deviation_contains_the_error(rng, find):
    held = []
    for _ in range(12):
        parent, child, place = joint_motion(rng, star(100), noise_m=1e-3)
        centre = find(parent, child)
        at = transfer_point(centre.parent_shape, centre.in_parent, parent)
        off = (at - place).mean(0)  # the cluster's own noise averages out over the frames
        held.append(np.linalg.norm(off) / np.sqrt(np.trace(centre.covariance)))
    assert 0.3 < np.sqrt(np.mean(np.square(held))) < 3


def test_the_axis_of_a_hinge_is_found_on_both_segments(rng):
    axis = np.array([0.6, 0.0, 0.8])
    turns = axis * np.linspace(0, 1.2, 100)[:, None]
    parent, child, place = joint_motion(rng, turns)
    hinge = sara(parent, child)
    ends = [
        transfer_point(hinge.parent_shape, hinge.point_in_parent + reach * hinge.in_parent, parent)
        for reach in (0.0, 1.0)
    ]
    along = ends[1] - ends[0]
    off = place - ends[0]
    across = off - np.einsum("fi,fi->f", off, along)[:, None] * along
    assert np.abs(across).max() < 1e-6
    tip = transfer_point(hinge.child_shape, hinge.point_in_child + hinge.in_child, child)
    base = transfer_point(hinge.child_shape, hinge.point_in_child, child)
    np.testing.assert_allclose(tip - base, along, atol=1e-7)


def test_a_hinge_has_no_centre_and_standing_still_no_axis(rng):
    parent, child, _ = joint_motion(rng, np.array([1.0, 0, 0]) * np.linspace(0, 1, 50)[:, None])
    with pytest.raises(MareyError, match="one axis only"):
        score(parent, child)
    parent, child, _ = joint_motion(rng, np.zeros((50, 3)))
    with pytest.raises(MareyError, match="do not rotate"):
        sara(parent, child)
    with pytest.raises(MareyError, match="rotates too little"):
        sphere_centre(parent, child)
    with pytest.raises(MareyError, match="5 frames"):
        score(parent[:5], child[:5])


@pytest.mark.slow
def test_the_hip_of_the_functional_trial_is_transferred_into_walking(shared):
    from marey.io.markers.readers import read_markers

    folder = shared / "data" / "markers" / "functional"
    pelvis, thigh = ("LASI", "RASI", "LPSI", "RPSI"), tuple(f"LF0{n}" for n in range(1, 6))
    trial, walk = read_markers(folder / "left_hip.c3d"), read_markers(folder / "walk.c3d")
    centre = score(trial.select(pelvis).points, trial.select(thigh).points)
    hip = transfer_point(centre.parent_shape, centre.in_parent, walk.select(pelvis).points)
    off = np.linalg.norm(hip - walk.select(["LeftHipCenterScore"]).points[:, 0], axis=-1)
    assert np.median(off) < 0.010  # 8.6 mm; required: 15 mm
