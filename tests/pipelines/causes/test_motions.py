"""Two motions that do not agree: the planted cause is named, and a sound pair has none."""

from dataclasses import replace

import numpy as np
import pytest

from marey.motion.comparison import compare
from marey.motion.recording import Recording
from marey.pipelines.causes.motions import motion_reasons

TIME = np.arange(0, 6, 0.02)
ERROR_M = 0.01


@pytest.fixture
def motion(rng) -> Recording:
    """Six points of a body that is not symmetric, which moves aperiodically and turns."""
    phases = rng.uniform(0, 6, (6, 3))
    home = np.array([[0, 0.1, 0.9], [0, -0.1, 0.9], [0.05, 0.1, 0.5], [0, -0.1, 0.5], [0.3, 0.2, 1.3], [0, -0.2, 1.3]])
    sway = 0.15 * np.sin(np.multiply.outer(TIME, rng.uniform(1, 4, (6, 3))) + phases)
    names = tuple(f"{side}_{part}" for part in ("hip", "knee", "wrist") for side in ("left", "right"))
    angles = np.stack([0.5 * np.sin(3 * TIME) + 0.03 * TIME**2, 0.4 * np.cos(1.3 * TIME**1.3)], 1)
    return Recording(
        time=TIME, point_names=names, points=home + sway, angle_names=("left_knee_flexion", "right_knee_flexion"),
        angles=angles,
    )  # fmt: skip


@pytest.fixture
def other(motion, rng) -> Recording:
    return replace(motion, points=motion.points + ERROR_M * rng.normal(size=motion.points.shape))


def causes(first: Recording, second: Recording, *, shift_s: float | None = None) -> list[str]:
    result = compare(first, second, shift_s=shift_s)
    return [str(reason) for reason in motion_reasons(first, second, result, shift_s=shift_s, same_laboratory=False)]


def test_a_sound_pair_has_no_cause(motion, other):
    assert causes(motion, other) == []


def test_a_unit_of_length_is_named(motion, other):
    [text] = causes(motion, replace(other, points=1e3 * other.points))
    assert text.startswith("The first motion is 0.001 times as large as the second: a unit of length is wrong.")


def test_degrees_as_radians_are_named(motion, other):
    [text] = causes(motion, replace(other, angles=np.degrees(other.angles)))
    assert text.startswith("The angles of the second motion are 57 times those of the first")


@pytest.mark.slow
def test_a_mirror_image_is_named(motion, other):
    [text] = causes(motion, replace(other, points=other.points * [1, -1, 1]))
    assert text.startswith("One motion is a mirror image: corrected, the motions differ by 1")


@pytest.mark.slow
def test_exchanged_sides_are_named(motion, other):
    order = [1, 0, 3, 2, 5, 4]
    [text] = causes(motion, replace(other, points=other.points[:, order], angles=other.angles[:, ::-1]))
    assert text.startswith("Left and right are exchanged: corrected")


@pytest.mark.slow
def test_a_short_overlap_is_named_with_its_shift(motion, other):
    early = replace(motion, time=TIME[:180], points=motion.points[:180], angles=motion.angles[:180], angles_sd=[])
    late = replace(other, time=TIME[:180], points=other.points[120:], angles=other.angles[120:], angles_sd=[])
    [text] = causes(early, late)
    assert text.startswith("The recordings overlap for 1.2 s only, at a shift of about -2.40 s: corrected")


@pytest.mark.slow
def test_a_shift_of_the_wrong_sign_is_named(motion, other):
    late = replace(other, time=TIME + 0.5)
    assert causes(motion, late, shift_s=0.5) == []
    [text] = causes(motion, late, shift_s=-0.5)
    assert "The shift of -0.5 s has the wrong sign" in text


@pytest.mark.slow
def test_another_motion_has_no_cause(motion, other, rng):
    assert (
        causes(motion, replace(other, points=rng.permutation(other.points, axis=1) + 0.2 * np.sin(TIME)[:, None, None]))
        == []
    )
