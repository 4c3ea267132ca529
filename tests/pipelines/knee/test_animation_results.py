"""The files of an animated knee: numbers, meshes, video and page, and the errors for invalid input."""

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import trimesh
from tests.made_animations import GAP_MM, MadeActivity, made_activity

from marey.errors import MareyError
from marey.io.npz import read_arrays
from marey.pipelines.knee.animate import animate_knee
from marey.pipelines.progress import RecordingProgress

FILES = {
    "knee_motion.npz", "proximity.csv", "correspondence.json", "knee.glb", "knee.mp4", "knee.html", "run.json",
}  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> MadeActivity:
    return made_activity(tmp_path_factory.mktemp("animate"), lost=(3,))


def animated(made: MadeActivity, out: Path, *, knee: Path | None = None, **options: Any) -> str:
    """Move the knee, write the files, and return the warnings."""
    progress = RecordingProgress()
    animate_knee(knee or made.knee, made.motion, reference=made.standing, out=out, progress=progress, **options)
    return " ".join(progress.warnings)


@pytest.fixture(scope="module")
def out(made: MadeActivity) -> Path:
    folder = made.knee.parent / "out"
    animated(made, folder, compare="rigid", views=("medial", "plateau"))
    return folder


def test_all_files_are_there_and_nothing_else(out: Path):
    assert {path.name for path in out.iterdir()} == FILES
    record = json.loads((out / "run.json").read_text(encoding="utf-8"))
    assert record["command"] == "knee animate"
    assert record["settings"]["side"] == "right"
    assert any("The patella is not moved" in note for note in record["warnings"])
    assert any("The femur has no pose in 1 of 6 frames" in note for note in record["warnings"])


def test_the_gap_is_the_true_one_and_lost_frames_stay_empty(out: Path):
    found = read_arrays(out / "knee_motion.npz")
    gap = found["tibiofemoral_gap_mm"]
    assert np.isnan(gap[3]).all()
    # The markers are known to some tenths of a millimetre; a coarse ball's facets lie up to 0.1 mm within.
    np.testing.assert_allclose(np.delete(gap, 3, 0), GAP_MM, atol=0.3)
    assert (np.delete(found["tibiofemoral_gap_sd_mm"], 3, 0) > 0.1).all()
    np.testing.assert_allclose(
        np.delete(found["compared_tibiofemoral_gap_mm"] - gap, [0, 3], 0), 3.0, atol=0.05
    )  # fmt: skip
    assert str(found["method"]) == "exact"
    assert str(found["compared_method"]) == "rigid"


def test_the_bones_move_as_they_did(out: Path, made: MadeActivity):
    found = read_arrays(out / "knee_motion.npz")
    assert found["bones"].tolist() == ["femur", "tibia"]
    for b, bone in enumerate(("femur", "tibia")):
        for f in (0, 2, 5):
            truth = made.laboratory_from_scanner[bone][f].matrix
            np.testing.assert_allclose(found["laboratory_from_scanner"][f, b, :3, :3], truth[:3, :3], atol=0.01)
            middle = np.array([0, 0, 10.0, 1])
            np.testing.assert_allclose(found["laboratory_from_scanner"][f, b] @ middle, truth @ middle, atol=0.5)
    np.testing.assert_allclose(found["tibia_from_bone"][:, 1], np.broadcast_to(np.eye(4), (6, 4, 4)), atol=1e-9)


def test_the_table_has_one_row_per_frame_compartment_and_correction(out: Path):
    with (out / "proximity.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 6 * 2
    lost = [row for row in rows if row["frame"] == "3"]
    assert all(row["gap_mm"] == "" == row["area_below_3mm_mm2"] for row in lost)
    assert {row["compartment"] for row in rows} == {"medial", "lateral"}


def test_the_glb_is_read_by_others_and_has_the_bones_above_each_other(out: Path):
    scene = trimesh.load(out / "knee.glb")
    names = set(scene.geometry)
    assert {"femur", "tibia", "femoral_cartilage", "tibial_cartilage"} <= names
    assert "patella" not in names
    heights = {name: scene.geometry[name].vertices[:, 2].mean() for name in ("femur", "tibia")}
    assert heights["femur"] > heights["tibia"]
    low, high = scene.bounds
    # Metres, Y up: the femur's and the tibia's shafts stand upright.
    assert np.argmax(high - low) == 1
    assert 0.1 < high[1] - low[1] < 0.4


def test_the_video_has_both_views_and_all_frames(out: Path):
    with av.open(str(out / "knee.mp4")) as video:
        pictures = [frame.to_ndarray(format="bgr24") for frame in video.decode(video=0)]
    assert len(pictures) == 3  # 50 Hz, at most 30 images a second
    assert pictures[0].shape == (460, 800, 3)


def test_the_page_contains_both_corrections_and_loads_nothing(out: Path):
    page = (out / "knee.html").read_text(encoding="utf-8")
    assert "http" not in page.replace("http://www.w3.org", "")
    data = json.loads(page.split('type="application/json">')[1].split("</script>")[0])
    assert [motion["label"] for motion in data["knee"]["motions"]] == ["exact", "rigid"]
    assert data["knee"]["carried"] == {"patella": "femur"}
    assert data["frames"] == 6


@pytest.mark.slow
def test_the_room_and_another_method_can_be_requested(made: MadeActivity, tmp_path: Path):
    animated(made, tmp_path, frame="room", method="rigid", views=("plateau",), limit_mm=4.0)
    found = read_arrays(tmp_path / "knee_motion.npz")
    assert str(found["method"]) == "rigid"
    np.testing.assert_allclose(found["tibiofemoral_gap_mm"][5], GAP_MM + 3, atol=0.3)
    assert float(found["tibiofemoral_limit_mm"]) == 4


@pytest.mark.slow
def test_an_interrupted_run_is_resumed_with_what_was_measured(made: MadeActivity, tmp_path: Path, monkeypatch):
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as first:
        first.setattr("marey.pipelines.knee.animation_results.VideoWriter", stopped)
        with pytest.raises(KeyboardInterrupt):
            animated(made, tmp_path / "out", views=("plateau",))
    assert [path.name for path in (tmp_path / "out").iterdir()] == [".work"]
    with monkeypatch.context() as second:
        second.setattr("marey.pipelines.knee.animate.joint_proximities", stopped)
        animated(made, tmp_path / "out", views=("plateau",))
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES


@pytest.fixture
def error_of(made: MadeActivity) -> Callable[..., str]:
    """Return the error of an animation that must fail and leave no files."""

    def failed(*, knee: Path | None = None, motion: Path | None = None, **options: Any) -> str:
        motion = motion or made.motion
        before = sorted(made.motion.iterdir())
        with pytest.raises(MareyError) as problem:
            animate_knee(knee or made.knee, motion, out=motion / "knee", progress=RecordingProgress(), **options)
        assert sorted(made.motion.iterdir()) == before
        return str(problem.value)

    return failed


def test_a_knee_without_markers_or_bones_is_an_error(made: MadeActivity, tmp_path: Path, error_of):
    shutil.copytree(made.knee, tmp_path / "knee")
    (tmp_path / "knee" / "markers.json").unlink()
    assert "markers.json" in error_of(knee=tmp_path / "knee")
    (tmp_path / "knee" / "tibia.ply").unlink()
    assert "has no tibia.ply" in error_of(knee=tmp_path / "knee")
    assert "is not a folder" in error_of(knee=tmp_path / "nowhere")


def test_a_folder_without_bones_is_an_error(made: MadeActivity, error_of):
    assert "has no bones.npz" in error_of(motion=made.knee)
    assert "no results of the method pct" in error_of(method="pct")


def test_a_standing_trial_without_the_activity_s_markers_is_an_error(made: MadeActivity, tmp_path: Path, error_of):
    other = made_activity(tmp_path, sided=True)
    assert "standing trial has 0 of the activity's markers" in error_of(reference=other.standing)


def test_too_few_common_markers_are_an_error(made: MadeActivity, tmp_path: Path, error_of):
    shutil.copytree(made.knee, tmp_path / "knee")
    table = json.loads((made.knee / "markers.json").read_text(encoding="utf-8"))
    few = {key: values[:2] for key, values in table.items()}
    (tmp_path / "knee" / "markers.json").write_text(json.dumps(few), encoding="utf-8")
    text = error_of(reference=made.standing, knee=tmp_path / "knee")
    assert "markers.json: cannot be related to" in text
    assert "No bone can be transformed" in text


def test_a_bone_that_can_be_joined_alone_is_moved(made: MadeActivity, tmp_path: Path):
    shutil.copytree(made.knee, tmp_path / "knee")
    table = json.loads((made.knee / "markers.json").read_text(encoding="utf-8"))
    kept = [row for row, bone in enumerate(table["marker_segment"]) if bone == "femur"]
    few = {key: [values[row] for row in kept] for key, values in table.items()}
    (tmp_path / "knee" / "markers.json").write_text(json.dumps(few), encoding="utf-8")
    text = animated(made, tmp_path / "out", knee=tmp_path / "knee", views=("medial",))
    assert "The tibia is not moved" in text
    assert (tmp_path / "out" / "knee.html").is_file()


@pytest.mark.slow
def test_bones_without_cartilage_are_measured_themselves_with_a_note(made: MadeActivity, tmp_path: Path):
    shutil.copytree(made.knee, tmp_path / "knee")
    for path in (tmp_path / "knee").glob("*_cartilage.ply"):
        path.unlink()
    text = animated(made, tmp_path / "out", knee=tmp_path / "knee", views=("plateau",))
    assert "The femur has no cartilage here" in text
    gap = read_arrays(tmp_path / "out" / "knee_motion.npz")["tibiofemoral_gap_mm"]
    np.testing.assert_allclose(gap[0], GAP_MM + 4, atol=0.4)  # two cartilages of 2 mm
