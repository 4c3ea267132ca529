import numpy as np
import pytest

from marey.errors import MareyError
from marey.geometry import rotations
from marey.motion.driving import GRAVITY, angular_velocity, driving_signal
from marey.motion.recording import Recording

TIME = np.arange(60) / 30


def motion():
    """The hips fall with 3 m/s2, a foot moves evenly by 2 m/s, a shank turns by 4 rad/s, a knee bends."""
    fall = np.stack([0 * TIME, 0 * TIME, 1 - 1.5 * TIME**2], axis=1)
    foot = np.stack([2 * TIME, 0 * TIME, 0 * TIME + 0.1], axis=1)
    axis = np.array([0.6, 0.0, 0.8])
    return Recording(
        time=TIME, point_names=("left_hip", "right_hip", "foot"), points=np.stack([fall, fall + 0.2, foot], axis=1),
        segment_names=("left_shank",),
        rotation=np.array([rotations.about(axis, np.array(4 * t)) for t in TIME])[:, None],
        angle_names=("left_knee_flexion",), angles=np.sin(TIME)[:, None],
    )  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "name", "expected"),
    [
        ("force", "", -3.0), ("turning", "left_shank", 4.0), ("acceleration", "foot", GRAVITY), ("speed", "foot", 2.0),
        ("acceleration", "left_hip", GRAVITY - 3), ("height", "foot", 0.1),
        ("angle", "left_knee_flexion", np.sin(TIME)),
    ],
)  # fmt: skip
def test_quantities_of_a_known_motion(kind, name, expected):
    found = driving_signal(motion(), kind, name)
    inner = slice(15, -15)  # the smoothing filter reaches 0.5 s
    np.testing.assert_allclose(found[inner], np.broadcast_to(expected, TIME.shape)[inner], rtol=1e-3)
    assert np.isfinite(found[1:-1]).all()


def test_the_angular_velocity_is_in_the_axes_of_the_segment():
    start = rotations.exp(np.array([0.3, -0.5, 0.2]))
    turned = np.array([start @ rotations.about(np.array([0.6, 0.0, 0.8]), np.array(4 * t)) for t in TIME])
    turned[20] = np.nan
    found = angular_velocity(Recording(time=TIME, segment_names=("head",), rotation=turned[:, None]), "head")
    known = np.delete(np.arange(1, 59), [18, 20])
    np.testing.assert_allclose(found[known], np.broadcast_to([2.4, 0.0, 3.2], (56, 3)), atol=1e-9)
    assert np.isnan(found[[0, 19, 21, 59]]).all()


def test_what_the_motion_lacks_is_named():
    for kind, name, why in (
        ("turning", "tail", "no segment 'tail'. It has: left_shank"), ("angle", "x", "no angle 'x'"),
        ("weight", "", "no quantity 'weight'. There are: force, turning"),
    ):  # fmt: skip
        with pytest.raises(MareyError, match=why):
            driving_signal(motion(), kind, name)
