"""The verdict on bones: sound markers, gaps, a missing calibration, and wrong units."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.trials import marker_points, write_reference, write_trial
from tests.verdicts import agreed_verdict

from marey.io.npz import write_arrays
from marey.pipelines.markers.bones import load_bones
from marey.pipelines.markers.estimate import estimate_bones, open_markers
from marey.pipelines.markers.verdict import bones_verdict
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.verdict import Verdict


@pytest.fixture
def folder(tmp_path) -> Path:
    write_trial(tmp_path / "walk.c3d", marker_points())
    write_reference(tmp_path / "frame0.npz")
    return tmp_path


def verdict_of(folder: Path, **options: Path) -> Verdict:
    """Estimate the bones, and return the verdict on which record, page and result agree."""
    opened, out = open_markers(folder / "walk.c3d", **options), folder / "out"
    bones = estimate_bones(opened, "rigid", out=out, progress=RecordingProgress())
    verdict = agreed_verdict(out / "run.json", page=out / "report.html")
    assert verdict == bones.verdict == load_bones(out).verdict
    return verdict


def test_sound_markers_are_good(folder):
    assert verdict_of(folder, reference=folder / "frame0.npz") == Verdict()


def test_gaps_and_angles_that_are_not_anatomical_are_limits(folder):
    points = marker_points()
    for label in ("thigh_01", "thigh_02", "thigh_03"):
        points[label][40:50] = np.nan
    write_trial(folder / "walk.c3d", points)
    verdict = verdict_of(folder)
    assert verdict.level == "usable with limits"
    text = str(verdict)
    assert "thigh: 10 of 120 frames have fewer than 3 markers and no result" in text
    assert "not known: the angles are rotations since the reference frame." in text


def test_a_reference_in_another_unit_is_not_usable(folder):
    with np.load(folder / "frame0.npz") as file:
        far = {key: 1e3 * value if key.endswith("_origin") else value for key, value in file.items()}
    write_arrays(folder / "far.npz", far)
    verdict = verdict_of(folder, reference=folder / "far.npz")
    assert not verdict.usable
    assert "Are its origins in millimetres" in verdict.reasons[0].what


def test_the_distance_of_the_markers_from_a_model_decides(shared):
    gait = shared / "data" / "markers" / "gait"
    trial = open_markers(
        gait / "walk.trc", model=gait / "model_scaled.osim", weights=gait / "ik_weights.xml", frames=(0, 3)
    )
    [run] = estimate_bones(trial, progress=RecordingProgress()).runs
    assert "do not determine subtalar_angle_r" in str(bones_verdict(trial, run))
    fitting = replace(run, model_rms_m=0.01, undetermined=())
    assert bones_verdict(trial, fitting) == Verdict()
    for distance_m, level in ((0.03, "usable with limits"), (0.3, "not usable")):
        verdict = bones_verdict(trial, replace(fitting, model_rms_m=distance_m))
        assert verdict.level == level
        assert f"{1e3 * distance_m:.0f} mm (RMS) from the model" in str(verdict)
