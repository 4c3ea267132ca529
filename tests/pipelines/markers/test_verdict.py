"""The verdict on bones: sound markers, gaps, a missing calibration, and wrong units."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.trials import marker_points, write_reference, write_static, write_trial
from tests.verdicts import agreed_verdict

from marey.errors import NotWritten
from marey.geometry import rotations
from marey.io.npz import write_arrays
from marey.pipelines.markers.bones import load_bones
from marey.pipelines.markers.estimate import estimate_bones, open_markers
from marey.pipelines.markers.results import RESULTS
from marey.pipelines.markers.verdict import bones_verdict
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.verdict import Verdict


@pytest.fixture
def folder(tmp_path) -> Path:
    write_trial(tmp_path / "walk.c3d", marker_points())
    write_reference(tmp_path / "frame0.npz")
    return tmp_path


def verdict_of(folder: Path, **options: Path | str) -> Verdict:
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


def test_the_distance_of_the_markers_from_a_model_decides(shared, monkeypatch):
    monkeypatch.setattr("marey.pipelines.markers.verdict.model_reasons", lambda *_, **__: ())
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


def verdict_against_static(folder: Path) -> Verdict:
    static = {"static": folder / "static.c3d", "clusters": folder / "landmarks.toml", "side": "right"}
    return verdict_of(folder, **static)


def test_a_static_trial_of_the_same_markers_is_good(folder):
    write_static(folder)
    assert verdict_against_static(folder) == Verdict()


def test_another_unit_than_in_the_static_trial_is_named(folder):
    write_static(folder, scale=0.1)
    verdict = verdict_against_static(folder)
    assert not verdict.usable
    assert "The markers are 10 times as far apart as in static.c3d" in verdict.reasons[0].what


def test_a_mirror_image_of_the_static_trial_is_named(folder):
    write_static(folder)
    write_trial(folder / "walk.c3d", {label: path * [1, -1, 1] for label, path in marker_points().items()})
    verdict = verdict_against_static(folder)
    assert not verdict.usable
    assert "The trial is a mirror image of static.c3d: mirrored back" in verdict.reasons[0].what


def test_labels_exchanged_against_the_static_trial_are_named_with_what_their_exchange_achieves(folder):
    write_static(folder)
    points = marker_points()
    points["thigh_01"], points["thigh_03"] = points["thigh_03"], points["thigh_01"]
    write_trial(folder / "walk.c3d", points)
    verdict = verdict_against_static(folder)
    assert not verdict.usable
    assert len(verdict.reasons) == 1
    assert "thigh_01 and thigh_03 look exchanged in every frame: exchanged back" in verdict.reasons[0].what
    assert "the markers of thigh differ by 0 mm instead of" in verdict.reasons[0].what


def test_a_marker_that_moved_since_the_static_trial_is_a_limit(folder):
    write_static(folder, {"thigh_02": marker_points(frames=1)["thigh_02"] + [0.0, 0.0, 0.05]})
    verdict = verdict_against_static(folder)
    assert verdict.level == "usable with limits"
    assert "thigh: thigh_02 is 50 mm from its place in static.c3d" in verdict.reasons[0].what


def test_the_static_trial_of_another_person_is_named(folder, rng):
    sound = marker_points(frames=1)
    write_static(folder, {label: place + 0.05 * rng.normal(size=3) for label, place in sound.items()})
    verdict = verdict_against_static(folder)
    assert not verdict.usable
    assert "thigh, shank: the markers differ from static.c3d by" in verdict.reasons[0].what
    assert "another person" in verdict.reasons[0].what


def test_a_page_of_the_user_is_reported_before_the_methods_run(folder, monkeypatch):
    monkeypatch.setattr("marey.pipelines.markers.estimate.run_methods", lambda *_: pytest.fail("the work has begun"))
    (folder / "out").mkdir()
    (folder / "out" / "report.html").write_text("mine")
    with pytest.raises(NotWritten, match="marey did not write what has this name"):
        verdict_of(folder, reference=folder / "frame0.npz")


def test_the_names_that_are_checked_before_the_work_are_those_of_results(folder):
    verdict_of(folder, reference=folder / "frame0.npz")
    assert set(RESULTS) <= {path.name for path in (folder / "out").iterdir()}


def turned_reference(folder: Path, turn: np.ndarray) -> Path:
    """A reference whose bones have other axes."""
    with np.load(folder / "frame0.npz") as file:
        arrays = {key: value @ turn if key.endswith("_rotation") else value for key, value in file.items()}
    write_arrays(folder / "turned.npz", arrays)
    return folder / "turned.npz"


@pytest.mark.parametrize("degrees", [60, 90])
def test_bones_whose_axes_are_not_the_flexion_axis_are_a_limit(folder, degrees):
    reference = turned_reference(folder, rotations.about(np.eye(3)[1], np.radians(degrees)))
    [reason] = verdict_of(folder, reference=reference).reasons
    assert reason.level == "usable with limits"
    assert reason.cause == "joint axes"
    # The made knee bends by 0.1 rad about another axis, too.
    measured = float(reason.what.split("knee by ")[1].split(" ")[0])
    assert measured == pytest.approx(degrees, abs=6)
    assert "(--static)" in reason.remedy


def test_axes_that_are_tilted_a_little_are_no_limit(folder):
    reference = turned_reference(folder, rotations.about(np.eye(3)[1], np.radians(10)))
    assert verdict_of(folder, reference=reference) == Verdict()


def test_angles_that_no_knee_has_are_a_limit(folder):
    with np.load(folder / "frame0.npz") as file:
        arrays = dict(file)
    arrays["shank_rotation"] = arrays["shank_rotation"] @ rotations.about(np.eye(3)[2], np.radians(45))
    write_arrays(folder / "straight.npz", arrays)
    [reason] = verdict_of(folder, reference=folder / "straight.npz").reasons
    assert reason.cause == "joint axes"
    # The true knee bends from 6 to 63 degrees.
    assert "No knee has such angles (knee: flexion -38 to 18 degrees)" in reason.what
