"""The tip of a pointer, and places that it shows."""

import numpy as np
import pytest
from tests.trials import true_bones

from marey.errors import MareyError
from marey.geometry import rotations
from marey.markers.preprocessing.pointer import pointed_place, tip_by_pivot, tip_of_shape, tip_on_line

SHAPE = np.array([[0.0, 0.0, 0.0], [0.0, 0.1, 0.0], [0.04, 0.05, 0.01], [-0.03, 0.06, -0.02]])
TIP = np.array([0.002, 0.25, -0.001])
CLUSTER = np.array([[0.05, -0.2, 0.07], [0.07, -0.28, 0.08], [-0.02, -0.3, 0.07], [-0.04, -0.22, 0.09]])


def turned(degrees: float, axes: int = 2, frames: int = 60) -> np.ndarray:
    """Rotations (F, 3, 3) that swing about one axis or two."""
    time = np.linspace(0, 1, frames)
    vectors = np.radians(degrees) * np.stack([np.sin(9 * time), np.sin(14 * time + 1), 0 * time], 1)
    return rotations.exp(vectors * (np.arange(3) < axes))


def pivoting(rotation: np.ndarray, noise: float = 0.0) -> np.ndarray:
    """Markers (F, M, 3) of the pointer whose tip rests in one place."""
    points = np.array([0.4, -0.3, 1.1]) + (SHAPE - TIP) @ np.swapaxes(rotation, 1, 2)
    return points + noise * np.random.default_rng(1).normal(size=points.shape)


def test_the_tip_on_the_line_is_beyond_the_last_marker():
    points = np.array([[[0.0, 0, 0], [0, 0, 0.2]], [[1, 0, 0], [1, 0.1, 0]], [[np.nan] * 3, [0, 0, 1]]])
    found = tip_on_line(points, 0.05)
    np.testing.assert_allclose(found[:2], [[0, 0, 0.25], [1, 0.15, 0]])
    assert np.isnan(found[2]).all()


def test_a_pivot_gives_the_tip_that_any_other_trial_shows():
    tip = tip_by_pivot(pivoting(turned(30.0)))
    assert tip.residual_m < 1e-12
    elsewhere, origin = turned(70.0), np.random.default_rng(3).normal(size=(60, 3))
    points = origin[:, None] + SHAPE @ np.swapaxes(elsewhere, 1, 2)
    points[4, 1] = np.nan
    np.testing.assert_allclose(tip_of_shape(points, tip), origin + elsewhere @ TIP, atol=1e-9)


def test_noise_of_the_markers_leaves_a_tip_within_its_uncertainty():
    """Noise of 0.3 mm turns the pointer, whose markers are 45 mm apart, by 0.3 / 45, and the tip 160 mm away by 1.1 mm.

    60 frames with swings of 30 degrees (0.5 rad) leave 1.1 mm / sqrt(60) / 0.5 = 0.3 mm; 1 mm is three of these.
    """
    tip = tip_by_pivot(pivoting(turned(30.0), noise=3e-4))
    points = pivoting(turned(10.0))
    np.testing.assert_allclose(tip_of_shape(points, tip), np.broadcast_to([0.4, -0.3, 1.1], (60, 3)), atol=1e-3)
    assert 2e-4 < tip.residual_m < 3e-3


@pytest.mark.parametrize(
    ("points", "wrong"),
    [
        (pivoting(turned(3.0)), "turns too little"),
        (pivoting(turned(40.0, axes=1)), "turns too little"),
        (pivoting(turned(40.0))[:, :2], "needs 3 markers"),
        (np.linspace(0, 1, 4)[None, :, None] * np.ones((20, 4, 3)), "off one line"),
    ],
    ids=["small swings", "one axis", "two markers", "in a line"],
)
def test_a_pivot_that_does_not_determine_the_tip_is_an_error(points, wrong):
    with pytest.raises(MareyError, match=wrong):
        tip_by_pivot(points)


def test_the_place_on_a_moving_segment_is_fixed_to_it():
    rotation, origin = true_bones()["thigh"]
    markers = origin[:, None] + CLUSTER @ np.swapaxes(rotation, 1, 2)
    place = np.array([0.01, -0.42, 0.05])
    tip = origin + rotation @ place
    tip[7] = np.nan
    found = pointed_place(markers, tip)
    assert found.motion_m < 1e-9
    # The place has the distances from the markers that it has in the bone.
    np.testing.assert_allclose(
        np.linalg.norm(found.shape - found.place, axis=1), np.linalg.norm(CLUSTER - place, axis=1), atol=1e-9
    )


def test_a_tip_that_does_not_rest_on_the_segment_is_an_error():
    rotation, origin = true_bones()["thigh"]
    markers = origin[:, None] + CLUSTER @ np.swapaxes(rotation, 1, 2)
    with pytest.raises(MareyError, match="does not rest on a landmark"):
        pointed_place(markers, np.broadcast_to(origin[0], origin.shape))
    with pytest.raises(MareyError, match="No frame shows the pointer and 3 markers"):
        pointed_place(markers, np.full_like(origin, np.nan))
