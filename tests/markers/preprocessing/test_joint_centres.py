"""Joint centres from skin markers and measurements."""

import numpy as np
import pytest

from marey.errors import MareyError
from marey.geometry import rotations
from marey.markers.preprocessing.joint_centres import chord_centre, harrington_hip_centre


def test_the_hip_centre_follows_the_coefficients_of_the_paper():
    right = harrington_hip_centre(0.15, 0.24, 0.9, left=False)
    expected = [-0.24 * 150 - 9.9, -0.16 * 240 - 0.04 * 900 - 7.1, 0.28 * 150 + 0.16 * 240 + 7.9]
    np.testing.assert_allclose(1e3 * right, expected, rtol=1e-12)


def test_the_left_hip_is_the_mirror_image_of_the_right_one():
    left, right = (harrington_hip_centre(0.15, 0.24, 0.9, left=side) for side in (True, False))
    np.testing.assert_allclose(left, right * [1, 1, -1])


def made(count: int = 20) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
    """Hips, lateral knees, wands and true knees (F, 3) [m] in many directions, and the distance."""
    rng = np.random.default_rng(5)
    turn = rotations.exp(rng.normal(size=(count, 3)))
    knee = rng.normal(size=(count, 3))
    hip, lateral, wand = (knee + turn @ np.array(p) for p in ([0, 0.4, 0], [0, 0, 0.057], [0, 0.15, 0.12]))
    return hip, lateral, wand, knee, 0.057


def test_the_chord_function_gives_the_centre_from_which_the_markers_were_made():
    hip, lateral, wand, knee, distance = made()
    np.testing.assert_allclose(chord_centre(hip, lateral, wand, distance), knee, atol=1e-12)


def test_the_centre_has_its_distance_a_right_angle_and_lies_in_the_plane():
    rng = np.random.default_rng(6)
    hip, lateral, wand = rng.normal(size=(3, 30, 3))
    centre = chord_centre(hip, lateral, wand, 0.05)
    np.testing.assert_allclose(np.linalg.norm(centre - lateral, axis=1), 0.05)
    np.testing.assert_allclose(((centre - lateral) * (centre - hip)).sum(1), 0, atol=1e-12)
    normal = np.cross(hip - lateral, wand - lateral)
    np.testing.assert_allclose(((centre - lateral) * normal).sum(1), 0, atol=1e-12)


@pytest.mark.parametrize(
    ("hip", "wand"), [([0, 0.04, 0], [0, 0, 1]), ([0, 0.4, 0], [0, 0.2, 0])], ids=["too near", "in a line"]
)
def test_markers_that_form_no_triangle_are_an_error(hip, wand):
    with pytest.raises(MareyError, match="triangle"):
        chord_centre(np.array(hip), np.zeros(3), np.array(wand), 0.05)
