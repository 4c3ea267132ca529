"""Moving a knee from Python: labels, settings, and what is not written."""

import numpy as np
import pytest
from tests.made_animations import GAP_MM, made_activity

from marey.errors import SettingProblem
from marey.pipelines.knee.animate import AnimateSettings, animate_knee
from marey.pipelines.progress import RecordingProgress


def test_gaps_and_angles_are_found_by_name(tmp_path):
    made = made_activity(tmp_path, fine=2)
    before = sorted(path.name for path in made.motion.iterdir())
    progress = RecordingProgress()
    moving = animate_knee(made.knee, made.motion, reference=made.standing, views=("plateau",), progress=progress)
    assert moving.moved == ("femur", "tibia")
    gap = moving.gaps["tibiofemoral medial"]
    # A coarse mesh has facets up to some tenths of a millimetre within its ball.
    np.testing.assert_allclose(np.asarray(gap), GAP_MM, atol=0.5)
    assert gap.unit == "mm"
    np.testing.assert_allclose(moving.angles["right knee flexion"].values, made.flexion_deg, atol=0.5)
    assert "tibiofemoral" in repr(moving)
    assert sorted(path.name for path in made.motion.iterdir()) == before
    pytest.importorskip("xarray")
    assert moving.to_xarray()["gap_tibiofemoral_medial"].attrs["units"] == "mm"


@pytest.mark.parametrize(
    "wrong", [{"side": "middle"}, {"frame": "femur"}, {"views": ("above",)}, {"limit_mm": 0.0}, {"noise_mm": -1.0}]
)
def test_impossible_settings_are_errors(wrong):
    with pytest.raises(SettingProblem, match="should be"):
        AnimateSettings(**wrong)
