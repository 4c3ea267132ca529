import numpy as np
import pytest

from marey.errors import SettingProblem
from marey.markers.methods import skin_forms

TIME = np.arange(120) / 100


def test_every_form_is_of_largest_size_one():
    forms = [
        skin_forms.linear_in_time(TIME),
        skin_forms.linear_in_turn(-2 * TIME),
        skin_forms.sinusoid(TIME, 0.6),
        skin_forms.spline(TIME, 5),
        skin_forms.custom("jump", lambda t: 7.0 * (t > 0.5)[:, None], TIME),
    ]
    for form in forms:
        np.testing.assert_allclose(np.abs(form.functions).max(0), 1, rtol=1e-3)
    assert [form.count for form in forms] == [1, 1, 2, 7, 1]
    assert skin_forms.constant(120).count == 0


def test_a_spline_and_a_constant_together_contain_every_cubic():
    functions = np.concatenate([np.ones((120, 1)), skin_forms.spline(TIME, 4).functions], 1)
    cubic = 1 - 2 * TIME + 3 * TIME**3
    left = cubic - functions @ np.linalg.lstsq(functions, cubic, rcond=None)[0]
    assert np.abs(left).max() < 1e-12


def test_an_unknown_turn_is_interpolated():
    turn = TIME.copy()
    turn[50] = np.nan
    np.testing.assert_allclose(
        skin_forms.linear_in_turn(turn).functions, skin_forms.linear_in_turn(TIME).functions, atol=1e-12
    )


def test_the_period_of_a_repeated_motion_is_found_to_a_frame(rng):
    signal = np.sin(2 * np.pi * TIME / 0.4)[:, None] + 0.1 * rng.normal(size=(120, 1))
    signal[10] = np.nan
    assert skin_forms.period_of(signal, 100.0) == pytest.approx(0.4, abs=0.011)


def test_what_does_not_repeat_has_no_period():
    assert skin_forms.period_of(TIME[:, None] ** 2, 100.0) is None
    assert skin_forms.period_of(np.zeros((50, 1)), 100.0) is None


def test_settings_that_make_no_form_are_errors():
    with pytest.raises(SettingProblem, match="period is 0"):
        skin_forms.sinusoid(TIME, 0.0)
    with pytest.raises(SettingProblem, match="0 pieces"):
        skin_forms.spline(TIME, 0)
    with pytest.raises(SettingProblem, match="'flat' should return"):
        skin_forms.custom("flat", lambda t: t, TIME)
    with pytest.raises(SettingProblem, match="joint is known"):
        skin_forms.linear_in_turn(np.full(5, np.nan))
