"""Every example runs on small data, and its result is right."""

import runpy
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from tests.pipelines.capture import reach

import marey

pytestmark = pytest.mark.filterwarnings("ignore::marey.errors.MareyWarning")
EXAMPLES = Path(__file__).parents[2] / "examples"
FRAMES = "42:46"


def run(name: str, *arguments: object):
    """Run an example's `main` with arguments; return its result."""
    (path,) = EXAMPLES.glob(f"{name}_*.py")
    return SimpleNamespace(**runpy.run_path(str(path))).main([str(each) for each in arguments])


@pytest.fixture(scope="module")
def trial(tmp_path_factory) -> Path:
    folder = reach.copy_half_trial(tmp_path_factory.mktemp("reach") / "trial")
    reach.give_silhouettes(folder)
    reach.give_start(folder, 43)
    (folder / "trial.toml").write_text('[start]\nfile = "clicks.json"\n')
    return folder


@pytest.fixture(scope="module")
def captured(trial: Path, tmp_path_factory) -> Path:
    pytest.importorskip("matplotlib")
    out = tmp_path_factory.mktemp("captured") / "knee"
    run("01", trial, "--frames", FRAMES, "--out", out)
    return out


@pytest.mark.slow
def test_a_knee_angle_is_captured_and_plotted(captured: Path):
    angle = marey.load_motion(captured).angles["left knee flexion"]
    low, high = angle[42:46].interval(0.95)
    assert np.all(low < high)
    assert (captured / "knee_angle.png").stat().st_size > 5000


@pytest.mark.slow
def test_a_camera_less_changes_the_angles_by_a_few_degrees(trial: Path):
    pytest.importorskip("pandas")
    comparison = run("02", trial, "--frames", "42:44", "--without", "cam04")
    assert comparison["left elbow flexion"].rms < np.radians(15)


@pytest.mark.slow
def test_bones_from_made_markers_are_those_of_the_video(captured: Path, tmp_path):
    bones = run("03", captured, "--out", tmp_path / "markers")
    assert set(bones.methods) == {"skin", "rigid"}
    assert (tmp_path / "markers" / "bones_rigid.npz").is_file()
    # The bones have anatomical axes: the knee bends about Z.
    assert not [reason for reason in bones.verdict.reasons if reason.cause == "joint axes"]
    video = marey.load_motion(captured)
    for side in ("left", "right"):
        angle = bones.angles[f"{side} knee flexion"].values
        np.testing.assert_allclose(angle, video.angles[f"{side} knee flexion"].values[video.measured], atol=5)


@pytest.mark.slow
def test_an_own_observation_raises_the_head(trial: Path):
    before, after = run("04", trial, "--frames", "42:44", "--raised", "0.03")
    assert after - before == pytest.approx(0.03, abs=0.01)


@pytest.mark.slow
def test_tracks_of_a_sheet_give_its_shape(tmp_path, capsys):
    pytest.importorskip("xarray")
    shapes = run("05", "--out", tmp_path / "shapes")
    error = float(capsys.readouterr().out.split("Error of the shape: ")[1].split(" %")[0])
    assert error < 15
    assert marey.load_shapes(tmp_path / "shapes").shape.shape == shapes.shape.shape


@pytest.mark.slow
def test_three_images_give_the_wall():
    pytest.importorskip("pandas")
    surface = run("06", "--spacing", "16")
    assert len(surface) > 300
    # The images carry no noise; what remains is their rounding to whole grey values.
    assert np.sqrt(np.mean(surface.points[:, 2] ** 2)) < 2e-4


@pytest.mark.slow
def test_a_made_knee_is_segmented_and_read_again(tmp_path, monkeypatch, tmp_path_factory):
    if find_spec("SimpleITK") is None:  # imported by marey alone: see `simple_itk`
        pytest.skip("SimpleITK is not installed")
    pytest.importorskip("pandas")
    from tests.made_knees import made_grid, made_labels, made_volume
    from tests.segmented_once import segment_bones_once

    from marey.io.mr.volumes import write_labels, write_volume

    segment_bones_once(monkeypatch, tmp_path_factory)
    volume = made_volume(made_grid((3.0, 3.0, 3.0)), "dark")
    write_volume(tmp_path / "knee.nii.gz", volume)
    write_labels(tmp_path / "template", made_labels(volume.grid))
    knee = run("07", tmp_path / "knee.nii.gz", "--template", tmp_path / "template", "--out", tmp_path / "out")
    assert set(knee.bones) == {"femur", "tibia", "patella"}
    again = run("07", tmp_path / "out", "--out", tmp_path / "again")
    np.testing.assert_array_equal(again.labels.labels, knee.labels.labels)


@pytest.mark.slow
def test_results_become_arrays_and_tables(captured: Path):
    pytest.importorskip("xarray")
    pytest.importorskip("pandas")
    path = run("08", captured)
    header, *rows = path.read_text().splitlines()
    assert "left_knee_flexion" in header
    assert rows


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_an_example_states_what_it_needs_and_shows(path: Path):
    text = path.read_text(encoding="utf-8")
    for heading in ("Input:", "Output:", "Features:"):
        assert heading in text
    assert f"python examples/{path.name}" in text
