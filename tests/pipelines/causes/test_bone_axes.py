"""Joint translations and angles that the markers do not determine."""

from dataclasses import replace

import numpy as np
import pytest

from marey.markers.kinematics.joint_angles import TRANSLATIONS, JointKinematics, joint_of
from marey.pipelines.causes.bone_axes import unmeasured_reasons

KNEE = joint_of("left_thigh", "left_shank")


def translated(range_m: float, sd_m: float) -> JointKinematics:
    wave = 0.5 * range_m * np.sin(np.linspace(0, 2 * np.pi, 101))
    values = np.stack([wave, wave, wave], 1)
    return JointKinematics(
        angle_names=(), angles=np.zeros((101, 0)), angles_sd=np.zeros((101, 0)),
        translation_names=tuple(f"left_knee_{name}" for name in TRANSLATIONS), translations=values,
        translations_sd=np.full_like(values, sd_m),
    )  # fmt: skip


def test_translations_with_intervals_of_many_times_their_range_are_noted():
    [reason] = unmeasured_reasons(translated(0.002, 0.01), [KNEE])
    assert reason.level == "good"
    assert "left knee ± 20 mm, with a range of 2.0 mm" in reason.what


@pytest.mark.parametrize(("range_m", "sd_m"), [(0.02, 0.01), (0.0005, 0.002), (0.002, np.nan)])
def test_translations_that_are_measured_or_have_narrow_or_unknown_intervals_are_not_named(range_m, sd_m):
    assert not list(unmeasured_reasons(translated(range_m, sd_m), [KNEE]))


@pytest.mark.parametrize(
    ("range_deg", "sd_deg", "named"), [(3, 4, True), (30, 4, False), (1, 1, False), (3, np.nan, False)]
)
def test_angles_with_intervals_wider_than_their_range_are_noted(range_deg, sd_deg, named):
    wave = np.radians(0.5 * range_deg) * np.sin(np.linspace(0, 2 * np.pi, 101))
    turned = replace(
        translated(0.02, 0.001), angle_names=("left_knee_adduction",), angles=wave[:, None],
        angles_sd=np.full((101, 1), np.radians(sd_deg)),
    )  # fmt: skip
    reasons = list(unmeasured_reasons(turned, [KNEE]))
    assert len(reasons) == named
    for reason in reasons:
        assert reason.level == "good"
        assert "left knee adduction ± 7.8 degrees, with a range of 3.0 degrees" in reason.what
