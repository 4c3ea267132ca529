"""Opening a marker trial and estimating its bones from Python: labels, round trip, and what is not written."""

import json
from pathlib import Path

import numpy as np
import pytest
from tests.trials import FRAMES, RATE, marker_points, true_bones, write_reference, write_trial

from marey.errors import FileProblem, MareyError, SettingProblem
from marey.pipelines.labelled import UnknownName
from marey.pipelines.markers.bones import Bones, load_bones
from marey.pipelines.markers.estimate import estimate_bones, open_markers
from marey.pipelines.markers.trial import MarkerTrial
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.verdict import NotUsable, Verdict, VerdictReason


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("trial")
    write_trial(folder / "walk.c3d", marker_points(), force=True)
    write_reference(folder / "frame0.npz")
    return folder


@pytest.fixture(scope="module")
def walk(folder) -> MarkerTrial:
    return open_markers(folder / "walk.c3d", reference=folder / "frame0.npz", frames=range(0, 90))


@pytest.fixture(scope="module")
def bones(walk) -> Bones:
    return estimate_bones(walk, ["rigid", "pct"])


def test_a_trial_describes_itself(walk):
    assert walk.segments == ("thigh", "shank")
    assert len(walk) == FRAMES
    assert walk.rate == RATE
    assert walk.points.shape == (FRAMES, 10, 3)
    assert np.isnan(walk.points[90:]).all()
    for text in ("walk.c3d", "10 markers", "120 frames at 100 Hz", "thigh, shank"):
        assert text in repr(walk)


def test_nothing_is_written_without_a_folder(folder, bones):
    assert sorted(path.name for path in folder.iterdir()) == ["frame0.npz", "walk.c3d"]
    assert bones.folder is None


def test_bones_have_names_units_and_standard_deviations(bones):
    flexion = bones.angles["Knee flexion"]
    time = np.arange(FRAMES) / RATE
    np.testing.assert_allclose(np.asarray(flexion)[:90], np.degrees(0.6 - 0.5 * np.cos(5 * time))[:90], atol=1e-3)
    assert flexion.unit == "deg"
    assert (flexion.sd[:90] > 0).all()
    assert flexion.flags[0] == ""
    assert flexion.flags[-1] == "not requested"
    assert bones.translations["knee distraction"].unit == "mm"
    np.testing.assert_allclose(bones.origins["shank"].values[:90], true_bones()["shank"][1][:90], atol=1e-5)
    with pytest.raises(UnknownName, match="knee flexion"):
        bones.angles["knee flx"]
    assert "thigh" in repr(bones)
    assert "90 of 90 frames" in repr(bones)
    assert "<table>" in bones._repr_html_()


def test_another_method_of_the_same_run_can_be_used(bones):
    assert bones.methods == ("rigid", "pct")
    assert bones.method("pct").methods == ("pct", "rigid")
    with pytest.raises(SettingProblem, match="rigid, pct"):
        bones.method("global")


def test_what_is_saved_can_be_read_and_copied(bones, tmp_path):
    out = bones.save(tmp_path / "out")
    names = sorted(path.name for path in out.iterdir())
    assert {"angles.csv", "angles.mot", "bones.npz", "bones_pct.npz", "motion.c3d", "report.html"} <= set(names)
    assert json.loads((out / "run.json").read_text())["settings"]["methods"] == ["rigid", "pct"]
    read = load_bones(out)
    assert read.methods == bones.methods
    assert read.anatomical
    assert read.side == "right"
    np.testing.assert_array_equal(read.frames, bones.frames)
    np.testing.assert_array_equal(read.motion.rotation, bones.motion.rotation)
    np.testing.assert_array_equal(read.method("pct").motion.rotation, bones.method("pct").motion.rotation)
    np.testing.assert_allclose(read.joints.angles, bones.joints.angles, atol=1e-7)
    np.testing.assert_allclose(read.joints.translations_sd, bones.joints.translations_sd, atol=1e-7)
    np.testing.assert_allclose(read.markers.places, bones.markers.places, atol=1e-8)
    assert read.markers.labels == bones.markers.labels
    assert str(read.summary()) == str(bones.summary())
    assert sorted(path.name for path in read.save(tmp_path / "copy").iterdir()) == names
    with pytest.raises(FileProblem, match=r"no bones\.npz"):
        load_bones(tmp_path)


def test_tables_and_labelled_arrays_have_the_names_of_the_files(bones):
    table = bones.to_pandas()
    assert table.index.name == "time_s"
    assert {"knee_flexion_deg", "knee_flexion_sd_deg", "knee_distraction_mm"} <= set(table.columns)
    pytest.importorskip("xarray")
    arrays = bones.to_xarray()
    assert arrays["origin"].attrs["units"] == "m"
    np.testing.assert_array_equal(
        arrays["angles"].sel(angle="knee_flexion").values, bones.angles["knee_flexion"].values
    )  # fmt: skip


def test_with_a_folder_the_same_call_writes_the_files_of_the_command(walk, tmp_path):
    progress = RecordingProgress()
    estimate_bones(walk, "rigid", out=tmp_path / "walk", progress=progress)
    assert (tmp_path / "walk" / "report.html").is_file()
    assert not (tmp_path / "walk" / ".work").exists()
    assert "Method rigid" in json.loads((tmp_path / "walk" / "run.json").read_text())["timings_s"]


def test_frames_must_be_successive(folder):
    with pytest.raises(SettingProblem, match="consecutive"):
        open_markers(folder / "walk.c3d", frames=range(0, 90, 2))


def written_verdict(problem: NotUsable, out: Path) -> dict[str, str]:
    """Return the only reason of a verdict as run.json has it, after a look at the page."""
    assert sorted(path.name for path in out.iterdir()) == ["report.html", "run.json"]
    assert problem.report == out / "report.html"
    record = json.loads((out / "run.json").read_text(encoding="utf-8"))
    assert record["command"] == "markers"
    [reason] = record["verdict"]["reasons"]
    assert reason["what"] in problem.report.read_text(encoding="utf-8")
    return reason


def test_markers_that_determine_no_motion_end_with_a_verdict_and_its_page(walk, tmp_path, monkeypatch):
    def fails(*given: object) -> None:
        raise MareyError("No method could be run on this trial.")

    monkeypatch.setattr("marey.pipelines.markers.estimate.run_methods", fails)
    with pytest.raises(NotUsable) as problem:
        estimate_bones(walk, "all", out=tmp_path / "out", progress=RecordingProgress())
    reason = written_verdict(problem.value, tmp_path / "out")
    assert (reason["level"], reason["cause"]) == ("not usable", "undetermined")
    assert reason["what"] == "walk.c3d: No method could be run on this trial."
    with pytest.raises(NotUsable, match="No method could be run") as problem:
        estimate_bones(walk, "all")
    assert problem.value.report is None


def test_a_static_trial_that_does_not_fit_ends_with_a_verdict_and_its_page(folder, tmp_path, monkeypatch):
    def fails(*given: object) -> None:
        raise NotUsable(Verdict.of([VerdictReason.failure("The static trial is of another person.", cause="other")]))

    monkeypatch.setattr("marey.pipelines.markers.estimate.cluster_trial", fails)
    with pytest.raises(NotUsable) as problem:
        open_markers(folder / "walk.c3d", out=tmp_path / "out")
    assert written_verdict(problem.value, tmp_path / "out")["cause"] == "other"
    with pytest.raises(NotUsable) as problem:
        open_markers(folder / "walk.c3d")
    assert problem.value.report is None
