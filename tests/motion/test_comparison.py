"""Two motions of one trial: the shift of the clocks, the offset of the laboratories, and what is left after both."""

from dataclasses import replace

import numpy as np
import pytest

from marey.errors import MareyError
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.motion.alignment import AlignmentSettings, align, long_run_variance
from marey.motion.comparison import agreement, compare, pooled_correlation
from marey.motion.recording import Recording, interpolated

SHIFT = 0.4321
SECOND_FROM_FIRST = RigidTransform.from_vector(np.array([0.3, -0.2, 1.5]), np.array([1.0, 2.0, -0.5]))


def body(time, *, noise=0.0, rng=None, second=False, segments=False):
    """A knee, a hip and four points at given times of one clock, as either system sees them."""
    at = time - SHIFT if second else time
    knee = 0.6 * np.sin(5.7 * at) + 0.2 * np.sin(13 * at + 1) + 0.1 * at
    angles = np.stack([knee, 0.3 * np.cos(5.7 * at) * np.exp(-at / 5)], 1)
    points = np.stack(
        [
            np.stack([0.3 * np.sin(1.3 * at + k) + 0.2 * k, 0.2 * np.cos(2.2 * at + 2 * k), 0.9 + 0.1 * k * knee], 1)
            for k in range(4)
        ],
        1,
    )
    turn = rotations.exp(np.stack([np.sin(at), 0.5 * np.cos(2 * at), 0.3 * np.sin(3.3 * at)], 1))[:, None]
    if second:
        points, turn = SECOND_FROM_FIRST.apply(points), SECOND_FROM_FIRST.rotation @ turn
    if noise:
        angles = angles + 2 * noise * rng.normal(size=angles.shape)
        points = points + noise * rng.normal(size=points.shape)
    if segments:
        return Recording(time=time, segment_names=("thigh",), rotation=turn)
    return Recording(
        time=time, angle_names=("knee", "hip"), angles=angles, point_names=tuple("abcd"), points=points,
        segment_names=("thigh",), rotation=turn,
    )  # fmt: skip


FIRST, SECOND = np.arange(0, 6, 1 / 100), np.arange(0.8, 7.5, 1 / 47.3)


def test_a_known_shift_and_offset_come_back_between_different_rates():
    found = align(body(FIRST), body(SECOND, second=True))
    # The cubic between the slower one's frames is good to some micrometres.
    assert found.shift_s == pytest.approx(SHIFT, abs=2e-5)
    between = found.first_from_second @ SECOND_FROM_FIRST
    assert np.linalg.norm(between.rotation_vector) < 2e-5
    np.testing.assert_allclose(between.translation, 0, atol=5e-5)
    assert np.isnan(found.rival_s)


@pytest.mark.slow
def test_the_settings_of_the_alignment_limit_what_is_estimated():
    few = align(body(FIRST), body(SECOND, second=True), settings=AlignmentSettings(least_frames=10_000))
    assert any("No time shift" in note for note in few.notes)
    strict = align(body(FIRST), body(SECOND, second=True), settings=AlignmentSettings(largest_shift_sd=0.0))
    assert strict.shift_s == 0
    assert any("no common quantity moves" in note for note in strict.notes)


@pytest.mark.slow
def test_the_stated_deviations_of_shift_and_offset_are_those_of_repeated_trials(rng):
    errors = []
    truth, noise_alone = SECOND_FROM_FIRST.inverse(), AlignmentSettings(repeated_sd_s=0.0, drift_sd=0.0)
    for _ in range(8):
        first, second = body(FIRST, noise=0.005, rng=rng), body(SECOND, noise=0.005, rng=rng, second=True)
        found = align(first, second, settings=noise_alone)
        turn = rotations.log(found.first_from_second.rotation @ truth.rotation.T) / found.turn_sd
        move = (found.first_from_second.translation - truth.translation) / found.translation_sd
        errors.append([(found.shift_s - SHIFT) / found.shift_sd_s, *turn, *move])
    # 56 draws: their root mean square has a standard deviation of 10 %, and more as those of one trial are correlated.
    assert 0.6 < np.sqrt(np.mean(np.square(errors))) < 1.4


def test_a_shift_is_as_uncertain_as_errors_that_repeat_and_clocks_that_drift_make_it(rng):
    first, second = body(FIRST, noise=0.005, rng=rng), body(SECOND, noise=0.005, rng=rng, second=True)
    alone, repeated, drifting = (
        align(first, second, settings=AlignmentSettings(repeated_sd_s=same, drift_sd=drift)).shift_sd_s ** 2
        for same, drift in ((0.0, 0.0), (2e-3, 0.0), (0.0, 3e-3))
    )
    assert repeated - alone == pytest.approx(2e-3**2, rel=1e-6)
    # Both are recorded from the first time of the second one on, until the end of the first.
    span = FIRST[-1] - max(0.0, SECOND[0] - SHIFT)
    assert np.sqrt(drifting - alone) == pytest.approx(3e-3 * span / np.sqrt(12), rel=0.02)


@pytest.mark.slow
def test_shifts_between_clocks_that_drift_are_within_their_stated_error(rng):
    errors = []
    for drift in rng.normal(0, 1e-3, 8):
        moved = SECOND + drift * (SECOND - SECOND.mean())
        other = replace(body(moved, noise=0.005, rng=rng, second=True), time=SECOND)
        found = align(body(FIRST, noise=0.005, rng=rng), other, settings=AlignmentSettings(drift_sd=1e-3))
        at = rng.uniform(*found_span(found.shift_s))
        true = SHIFT - drift * (at + SHIFT - SECOND.mean())
        errors.append((found.shift_s - true) / found.shift_sd_s)
    # Eight draws determine a root mean square to 25 %.
    assert 0.4 < np.sqrt(np.mean(np.square(errors))) < 1.6


def found_span(shift: float) -> tuple[float, float]:
    """First and last common time of both recordings on the first clock."""
    return max(FIRST[0], SECOND[0] - shift), min(FIRST[-1], SECOND[-1] - shift)


def test_orientations_alone_give_shift_and_turn_whatever_the_segments_frames_are():
    first = body(FIRST, segments=True)
    constant = rotations.exp(np.array([0.2, 0.5, -0.3]))
    other = body(SECOND, second=True, segments=True)
    other = Recording(time=other.time, segment_names=other.segment_names, rotation=other.rotation @ constant)
    result = compare(first, other)
    assert result.alignment.shift_s == pytest.approx(SHIFT, abs=1e-4)
    np.testing.assert_allclose(
        result.alignment.first_from_second.rotation @ SECOND_FROM_FIRST.rotation, np.eye(3), atol=1e-3
    )
    np.testing.assert_allclose(rotations.exp(result.segment_offset[0]), constant, atol=1e-3)
    plain, steady = result.agreements
    assert plain.rms == pytest.approx(np.linalg.norm([0.2, 0.5, -0.3]), abs=1e-3)
    assert steady.rms < 1e-3


def test_a_shift_and_a_laboratory_that_are_known_stay():
    found = align(body(FIRST), body(SECOND, second=True), shift_s=SHIFT, same_laboratory=True)
    assert found.shift_s == SHIFT
    assert np.isnan(found.shift_sd_s)
    np.testing.assert_array_equal(found.first_from_second.matrix, np.eye(4))
    assert found.residual_m > 1


def test_a_motion_that_repeats_itself_is_reported_with_a_second_shift():
    time = np.arange(0, 8, 0.02)
    wave = Recording(time=time, angle_names=("knee",), angles=np.sin(2 * np.pi * time)[:, None])
    found = align(wave, wave)
    # A shift by one cycle fits as well as none, but leaves less in common.
    assert found.shift_s == pytest.approx(0, abs=1e-6)
    assert abs(found.rival_s) == pytest.approx(round(abs(found.rival_s)), abs=0.02)


@pytest.mark.slow
def test_points_that_differ_over_the_whole_trial_make_the_offset_less_certain(rng):
    first, second = body(FIRST), body(SECOND, second=True)
    plain = align(first, second)
    # Joint centres that one system sees some centimetres off, each in a direction of its own.
    errors = []
    for _ in range(6):
        other = replace(second, points=second.points + 0.03 * rng.normal(size=(4, 3)))
        found = align(first, other)
        errors.append(found.first_from_second.translation - SECOND_FROM_FIRST.inverse().translation)
        errors[-1] = errors[-1] / found.translation_sd
        assert (found.translation_sd > 10 * plain.translation_sd).all()
    # 18 numbers: their root mean square has a standard deviation of 17 %, and more as the spread is from four points.
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.6


def test_nothing_that_moves_gives_no_shift_and_this_is_reported():
    time = np.arange(0, 2, 0.02)
    still = Recording(time=time, angle_names=("knee",), angles=np.full((len(time), 1), 0.3))
    found = align(still, still)
    assert (found.shift_s, len(found.notes)) == (0.0, 1)
    assert np.isnan(found.shift_sd_s)


def test_bias_limits_and_correlation_are_those_of_bland_and_altman():
    first = np.array([1.0, 2.0, 3.0, 4.0, np.nan])
    second = np.array([0.5, 2.5, 2.0, 4.0, 1.0])
    row = agreement("knee", "angle", first, second, np.full(5, 0.3))
    difference = np.array([0.5, -0.5, 1.0, 0.0])
    assert row.frames == 4
    assert row.bias == pytest.approx(0.25)
    assert row.rms == pytest.approx(np.sqrt(1.5 / 4))
    assert row.limits == pytest.approx((0.25 - 1.96 * difference.std(ddof=1), 0.25 + 1.96 * difference.std(ddof=1)))
    assert row.correlation == pytest.approx(np.corrcoef(first[:4], second[:4])[0, 1])
    assert row.within_stated == pytest.approx(0.75)


def test_angles_that_differ_by_a_whole_turn_are_equal():
    time = np.arange(0, 3, 0.02)
    wave = np.sin(4 * time + time**2)[:, None]
    result = compare(
        Recording(time=time, angle_names=("a",), angles=wave),
        Recording(time=time, angle_names=("a",), angles=(wave + 3 * np.pi) % (2 * np.pi) - np.pi + 2 * np.pi),
        shift_s=0.0,
    )
    assert result.agreements[0].rms < 1e-9


def test_nothing_is_interpolated_across_a_gap_or_beyond_an_end():
    time = np.arange(10.0)
    values = time**2
    values[4:6] = np.nan
    read = interpolated(time, values, np.array([-0.5, 2.5, 3.0, 3.5, 4.5, 6.0, 8.25, 9.5]))
    np.testing.assert_array_equal(np.isfinite(read), [False, True, True, False, False, True, True, False])
    np.testing.assert_allclose(read[[1, 2, 5, 6]], [6.25, 9, 36, 8.25**2], atol=1e-9)
    assert interpolated(time, values, np.array([7.0]), derivative=1)[0] == pytest.approx(14)


def test_motions_with_nothing_in_common_are_rejected():
    time = np.arange(0, 2, 0.02)
    one = Recording(time=time, angle_names=("a",), angles=np.zeros((len(time), 1)))
    other = Recording(time=time, angle_names=("b",), angles=np.zeros((len(time), 1)))
    with pytest.raises(MareyError, match="same name"):
        compare(one, other)
    with pytest.raises(MareyError, match="no time in common"):
        compare(one, one, shift_s=10.0)


def test_the_long_run_variance_of_independent_scores_is_their_variance(rng):
    scores = rng.normal(size=(4000, 1))
    # Each lag adds twice a product of variance n: five fading lags scatter by about 2 sqrt(n sum w^2).
    assert long_run_variance(scores, 5)[0, 0] == pytest.approx(4000, rel=0.15)


def test_the_quantities_that_move_most_decide_whether_two_motions_are_alike(rng):
    time = np.arange(0, 4, 0.01)
    wave, noise = np.sin(time)[:, None], 0.01 * rng.normal(size=(2, len(time), 5))
    first, second = (np.concatenate([wave, each], 1) for each in noise)
    # The noise adds 5 * 0.01^2 to a variance of about 1/2.
    assert pooled_correlation(first, second) == pytest.approx(1 / (1 + 5e-4 / np.var(wave)), abs=1e-4)
    assert pooled_correlation(first, -second) == pytest.approx(-pooled_correlation(first, second))
    second[::2] = np.nan
    assert pooled_correlation(first, second) > 0.99
    assert np.isnan(pooled_correlation(0 * first, second))


def test_all_quantities_of_a_kind_agree_together_without_constant_offsets():
    time = np.arange(0, 4, 0.01)
    first = body(time)
    constant = rotations.exp(np.array([0.2, 0.5, -0.3]))
    second = replace(first, angles=first.angles[:, ::-1], rotation=first.rotation @ constant)
    result = compare(first, second, shift_s=0.0, same_laboratory=True)
    found = {each.kind: each for each in result.together}
    assert [(kind, each.count) for kind, each in found.items()] == [("angles", 2), ("points", 4), ("orientations", 1)]
    about = first.angles - first.angles.mean(0)
    assert found["angles"].correlation == pytest.approx(2 * (about[:, 0] @ about[:, 1]) / (about**2).sum())
    assert found["points"].rms == pytest.approx(0, abs=1e-9)
    assert found["orientations"].rms == pytest.approx(0, abs=1e-6)
    assert found["orientations"].correlation == pytest.approx(1)


def test_the_frames_that_are_compared_are_those_with_both_values():
    time = np.arange(0, 4, 0.01)
    first, angles = body(time), np.array(body(time).angles)
    angles[100:150, 0] = np.nan
    result = compare(first, replace(first, angles=angles), shift_s=0.0, same_laboratory=True)
    assert len(result.time) == 400
    assert result.compared_frames == (350, 400)
