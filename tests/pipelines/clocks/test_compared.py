"""The verdict on a comparison of two motions."""

from dataclasses import replace

import numpy as np
import pytest
from tests.verdicts import agreed_verdict

from marey.geometry import rotations
from marey.io.opensim.mot_sto import TimeSeriesTable, write_table
from marey.motion.anatomical import euler_angles
from marey.motion.comparison import MotionComparison
from marey.motion.comparison import compare as compare_motions
from marey.motion.recording import Recording
from marey.pipelines.causes.motions import motion_reasons
from marey.pipelines.clocks.compared import compare_defined, comparison_verdict
from marey.pipelines.compare import Comparison, compare, frames_text, notes_of

TIME = np.arange(0, 4, 0.01)
KNEE = 35 - 30 * np.cos(5 * TIME) + 5 * np.sin(11 * TIME) + 3 * TIME


@pytest.fixture
def compared(tmp_path):
    def compared(values: np.ndarray) -> Comparison:
        for name, column in (("a", KNEE), ("b", values)):
            table = TimeSeriesTable(name=name, columns=("left_knee_flexion",), time=TIME, values=column[:, None])
            write_table(tmp_path / f"{name}.mot", table)
        found = compare(tmp_path / "a.mot", tmp_path / "b.mot")
        found.save(tmp_path / "out")
        assert agreed_verdict(tmp_path / "out" / "run.json", page=tmp_path / "out" / "report.html") == found.verdict
        return found

    return compared


def test_two_recordings_of_one_motion_are_good(compared):
    assert compared(KNEE + 4).verdict.level == "good"


def test_a_shift_that_is_not_determined_is_a_limit(compared):
    verdict = compared(0 * KNEE + 20).verdict
    assert verdict.level == "usable with limits"
    assert "time shift" in str(verdict)


def test_another_motion_is_not_usable(compared):
    verdict = compared(20 * np.sin(40 * TIME)).verdict
    assert verdict.level == "not usable"
    assert "do not rise and fall together" in str(verdict)


def leg(angles_from: np.ndarray, *, sd: float = np.nan) -> Recording:
    """A thigh that swings and a knee that bends, with angles between axes that are turned by a constant."""
    tilt = 0.2 * np.stack([np.sin(2.3 * TIME), np.cos(1.7 * TIME + 0.2 * TIME**2), 0 * TIME], 1)
    swing = rotations.exp(tilt) @ about_z(np.radians(20 * np.sin(3 * TIME + 0.4 * TIME**2)))
    bend = about_z(np.radians(-KNEE))
    rotation = np.stack([swing, swing @ bend], 1)
    relative = np.swapaxes(rotation[:, 0] @ angles_from, 1, 2) @ rotation[:, 1] @ angles_from
    angles = euler_angles(relative, "ZXY") * [-1, 1, 1]
    return Recording(
        time=TIME, angle_names=tuple(f"right_knee_{name}" for name in ("flexion", "adduction", "rotation")),
        angles=angles, angles_sd=np.full_like(angles, sd), segment_names=("right_thigh", "right_shank"),
        rotation=rotation,
    )  # fmt: skip


def about_z(angle: np.ndarray) -> np.ndarray:
    return rotations.about(np.array([0.0, 0.0, 1.0]), angle)


def compared_legs(second: Recording) -> MotionComparison:
    return compare_defined(leg(np.eye(3)), second, shift_s=None, same_laboratory=True, free_rate=False)


def test_angles_by_other_axes_are_named_where_the_orientations_agree():
    result = compared_legs(leg(rotations.about(np.array([0.0, 1.0, 0.0]), np.array(np.pi / 2))))
    verdict = comparison_verdict(result)
    assert verdict.level == "usable with limits"
    # The angles alone fit best at another shift.
    assert result.alignment.shift_s == pytest.approx(0, abs=1e-3)
    [reason] = verdict.reasons
    assert reason.cause == "joint axes"
    assert "right knee flexion, right knee adduction, right knee rotation" in reason.what
    assert "not rise and fall" not in str(verdict)
    assert not motion_reasons(result.first, result.second, result, shift_s=None, same_laboratory=False)


def test_angles_by_equal_axes_are_not_named_whatever_their_constant_offset():
    same = leg(np.eye(3))
    assert comparison_verdict(compared_legs(same)).level == "good"
    assert comparison_verdict(compared_legs(replace(same, angles=same.angles + 0.3))).level == "good"


def test_the_correlation_in_the_verdict_is_that_in_the_table_of_the_page(compared, tmp_path):
    verdict = compared(20 * np.sin(40 * TIME)).verdict
    value = verdict.reasons[0].what.split("(correlation ")[1].split(" ")[0]
    page = (tmp_path / "out" / "report.html").read_text()
    row = page.split(">all angles<")[1].split("</tr>")[0]
    assert value.replace("-", "−") in row


def test_intervals_that_do_not_hold_the_differences_are_a_limit_and_named(tmp_path):
    narrow, fitting = (leg(np.eye(3), sd=np.radians(sd)) for sd in (0.2, 2.0))
    moved = compared_legs(replace(narrow, angles=narrow.angles + np.radians([3.0, 0.0, 0.0])))
    [reason] = comparison_verdict(moved).reasons
    assert reason.cause == "narrow intervals"
    assert "hold 67 % of the differences" in reason.what
    notes = [note for note in notes_of(moved) if "mostly larger" in note]
    assert notes == ["Differences mostly larger than the stated 95 % intervals: right knee flexion (0 % within)."]
    moved = compared_legs(replace(fitting, angles=fitting.angles + np.radians([3.0, 0.0, 0.0])))
    assert not comparison_verdict(moved).reasons


def test_frames_that_are_not_compared_are_stated():
    second = leg(np.eye(3))
    angles, rotation = np.array(second.angles), np.array(second.rotation)
    angles[100:180], rotation[100:180] = np.nan, np.nan
    result = compare_motions(second, replace(second, angles=angles, rotation=rotation), shift_s=0.0)
    assert frames_text(result) == "320 compared, of 400 in common, 3.99 s"
    assert any(note.startswith("80 of 400 frames in both motions are not compared") for note in notes_of(result))
