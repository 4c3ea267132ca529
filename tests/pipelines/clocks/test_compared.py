"""The verdict on a comparison of two motions."""

import numpy as np
import pytest
from tests.verdicts import agreed_verdict

from marey.io.opensim.mot_sto import TimeSeriesTable, write_table
from marey.pipelines.clocks.compared import pooled_correlation
from marey.pipelines.compare import Comparison, compare

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


def test_the_quantities_that_move_most_decide_whether_two_motions_are_alike(rng):
    wave, noise = np.sin(TIME)[:, None], 0.01 * rng.normal(size=(2, len(TIME), 5))
    first, second = (np.concatenate([wave, each], 1) for each in noise)
    # The noise adds 5 * 0.01^2 to a variance of about 1/2.
    assert pooled_correlation(first, second) == pytest.approx(1 / (1 + 5e-4 / np.var(wave)), abs=1e-4)
    assert pooled_correlation(first, -second) == pytest.approx(-pooled_correlation(first, second))
    second[::2] = np.nan
    assert pooled_correlation(first, second) > 0.99
    assert np.isnan(pooled_correlation(0 * first, second))
