"""The commands `marey knee`: options, printed text and exit codes."""

import json
import shutil
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from tests.made_animations import MadeActivity, made_activity
from tests.made_bones import made_bone
from tests.made_knees import made_grid, made_labels, made_volume
from tests.segmented_once import segment_bones_once
from tests.verdicts import agreed_verdict

from marey.cli.knee import parse_seed, with_seeds_joined
from marey.cli.main import INTERRUPTED, WRONG_INPUT, run
from marey.cli.work import NOT_USABLE
from marey.errors import SettingProblem
from marey.io.mr.contours import write_contours
from marey.io.mr.meshes import write_mesh
from marey.io.mr.volumes import write_labels, write_volume
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.volume import VoxelGrid
from marey.pipelines.verdict import Verdict, VerdictReason

NEEDS_IMAGES = pytest.mark.skipif(find_spec("SimpleITK") is None, reason="SimpleITK is not installed")
ANIMATE_SETTINGS = [
    (["--frame", "femur"], "should be tibia or room"), (["--view", "above"], "view (--view) is 'above'"),
    (["--limit", "0"], "--limit"), (["--noise", "-1"], "--noise"), (["--side", "middle"], "--side"),
]  # fmt: skip


def interrupt(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def ball(radius: float) -> TriangleSurface:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return TriangleSurface(vertices_mm=mesh.vertices, faces=mesh.faces)


def test_four_words_of_a_seed_become_one_and_negative_numbers_stay():
    words = "knee segment a.nii --seed femur -3.5 2 -1 --seed-voxel tibia 1 2 3 -q"
    arguments = words.split()
    joined = ["knee", "segment", "a.nii", "--seed", "femur -3.5 2 -1", "--seed-voxel", "tibia 1 2 3", "-q"]
    assert with_seeds_joined(arguments) == joined
    assert with_seeds_joined(joined) == joined
    assert with_seeds_joined(["capture", "--seed", "a", "b"]) == ["capture", "--seed", "a", "b"]


def test_errors_on_seeds_state_what_would_be_right():
    with pytest.raises(SettingProblem, match="a bone and three numbers"):
        parse_seed("femur 1 2", "--seed")


def segmented(monkeypatch: pytest.MonkeyPatch, verdict: Verdict) -> dict[str, Any]:
    """Replace the segmentation, and return the options that the command passes to it."""
    given: dict[str, Any] = {}

    def segment_knee(volumes: list[Path], **options: Any) -> SimpleNamespace:
        given.update(options, volumes=volumes)
        return SimpleNamespace(bones=("femur",), surfaces={"femur": ball(20.0)}, verdict=verdict)

    monkeypatch.setattr("marey.pipelines.knee.segment.segment_knee", segment_knee)
    return given


def test_the_options_of_a_segmentation_reach_the_pipeline(tmp_path, capsys, monkeypatch):
    given = segmented(monkeypatch, Verdict())
    words = "knee segment a.nii.gz b.nii --template atlas --seed femur -3.5 2 -1 --seed-voxel tibia 1 2 3 --side left"
    assert run(words.split()) == 0
    del given["progress"]
    assert given == {
        "volumes": [Path("a.nii.gz"), Path("b.nii")], "template": Path("atlas"), "seeds": [("femur", -3.5, 2.0, -1.0)],
        "seed_voxels": [("tibia", 1.0, 2.0, 3.0)], "side": "left", "out": Path("a_marey"),
    }  # fmt: skip
    printed = capsys.readouterr()
    assert printed.out == "Verdict: good\nLabels: a_marey/labels.nii.gz\nReport: a_marey/report.html\n"
    assert "femur: 33.2 cm3, 50 cm2" in printed.err


@NEEDS_IMAGES
@pytest.mark.slow
def test_a_volume_is_segmented(tmp_path, capsys, monkeypatch, tmp_path_factory):
    segment_bones_once(monkeypatch, tmp_path_factory)
    volume = made_volume(made_grid((3.0, 3.0, 3.0)), "dark")
    write_volume(tmp_path / "knee.nii.gz", volume)
    write_labels(tmp_path / "template", made_labels(volume.grid))
    words = ["knee", "segment", str(tmp_path / "knee.nii.gz"), "--template", str(tmp_path / "template")]
    assert run([*words, "--side", "left"]) == 0
    out = tmp_path / "knee_marey"
    assert f"Report: {out / 'report.html'}" in capsys.readouterr().out
    assert {"femur.ply", "tibia.ply", "patella.ply", "report.html"} <= {path.name for path in out.iterdir()}


@pytest.mark.parametrize(("make", "code"), [(VerdictReason.limit, 0), (VerdictReason.failure, NOT_USABLE)])
def test_the_exit_code_of_a_segmentation_is_that_of_its_verdict(capsys, monkeypatch, make, code):
    segmented(monkeypatch, Verdict.of([make("The bone was not found.")]))
    assert run(["knee", "segment", "knee.nii.gz", "-q"]) == code
    assert "- The bone was not found.\nLabels: " in capsys.readouterr().out


def test_wrong_input_and_ctrl_c_of_a_segmentation_have_their_exit_codes(tmp_path, capsys, monkeypatch):
    assert run(["knee", "segment", str(tmp_path / "missing.nii.gz"), "-q"]) == WRONG_INPUT
    assert "missing.nii.gz" in capsys.readouterr().err
    monkeypatch.setattr("marey.pipelines.knee.segment.segment_knee", interrupt)
    assert run(["knee", "segment", str(tmp_path / "missing.nii.gz"), "-q"]) == INTERRUPTED
    assert list(tmp_path.iterdir()) == []


def test_thickness_is_measured_and_printed(tmp_path, capsys):
    inner, outer = ball(20.0), ball(22.0)
    count = len(inner.vertices_mm)
    shell = TriangleSurface(
        vertices_mm=np.concatenate([inner.vertices_mm, outer.vertices_mm]),
        faces=np.concatenate([inner.faces[:, ::-1], outer.faces + count]),
    )
    write_mesh(tmp_path / "bone.ply", inner)
    write_mesh(tmp_path / "cartilage.ply", shell)
    assert run(["knee", "thickness", str(tmp_path / "bone.ply"), str(tmp_path / "cartilage.ply")]) == 0
    text, out = capsys.readouterr().out, tmp_path / "bone_marey"
    assert "thickness: mean 2.0" in text
    assert f"Thickness: {out / 'thickness.npz'}" in text
    assert {path.name for path in out.iterdir()} == {"run.json", "thickness.npz", "thickness.ply"}


def test_a_missing_mesh_is_named_and_leaves_nothing(tmp_path, capsys):
    assert run(["knee", "thickness", str(tmp_path / "bone.ply"), str(tmp_path / "cartilage.ply")]) == WRONG_INPUT
    assert "bone.ply" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_bone_is_registered_and_its_side_is_reported(tmp_path, capsys):
    bone = made_bone(shaft_mm=30.0, size=0.55, fine=2)
    for name in ("template", "femur"):
        write_mesh(tmp_path / f"{name}.ply", bone)
    assert run(["knee", "register", str(tmp_path / "template.ply"), str(tmp_path / "femur.ply")]) == 0
    printed, out = capsys.readouterr(), tmp_path / "femur_marey"
    assert "The template is of the same side" in " ".join(printed.err.split())
    assert "rigid: mean distance" in printed.err
    assert printed.out.endswith(f"\nRegistered: {out / 'registered.ply'}\n")
    agreed_verdict(out / "run.json", printed=printed.out)
    assert {path.name for path in out.iterdir()} == {"registered.ply", "rigid.json", "run.json"}


@pytest.mark.parametrize(("option", "mirror"), [([], None), (["--mirror"], True), (["--no-mirror"], False)])
def test_the_side_of_a_template_can_be_given_and_an_error_leaves_nothing(tmp_path, monkeypatch, option, mirror):
    given: dict[str, Any] = {}

    def register_bone(template: Path, subject: Path, **options: Any) -> None:
        given.update(options)
        raise SettingProblem("It does not fit.")

    monkeypatch.setattr("marey.pipelines.knee.register.register_bone", register_bone)
    assert run(["knee", "register", str(tmp_path / "a.ply"), str(tmp_path / "b.ply"), *option]) == WRONG_INPUT
    assert given["mirror"] is mirror
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_is_reported_before_the_work(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(
        "marey.pipelines.knee.register.register_on_either_side", lambda *_, **__: pytest.fail("too late")
    )
    for name in ("template", "femur"):
        write_mesh(tmp_path / f"{name}.ply", made_bone(fine=2))
    words = ["knee", "register", str(tmp_path / "template.ply"), str(tmp_path / "femur.ply"), "--out"]
    assert run([*words, str(tmp_path / "femur.ply" / "below")]) == WRONG_INPUT
    assert "cannot be created (Not a directory)" in capsys.readouterr().err


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> MadeActivity:
    return made_activity(tmp_path_factory.mktemp("animate"), fine=2)


@pytest.mark.slow
def test_a_knee_is_animated_and_its_gaps_are_printed(made, tmp_path, capsys):
    words = ["knee", "animate", str(made.knee), str(made.motion), "--reference", str(made.standing)]
    words += ["--compare", "rigid", "--view", "medial, plateau", "--out", str(tmp_path / "out")]
    assert run(words) == 0
    printed = capsys.readouterr()
    assert printed.out.endswith(f"\nPage: {tmp_path / 'out' / 'knee.html'}\n")
    agreed_verdict(tmp_path / "out" / "run.json", printed=printed.out, page=tmp_path / "out" / "knee.html")
    assert "exact: tibiofemoral, medial: gap" in printed.err
    assert "rigid: tibiofemoral, lateral: gap" in printed.err
    record = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))
    assert record["settings"]["views"] == ["medial", "plateau"]


def test_a_bone_that_is_not_moved_has_its_own_exit_code(made, tmp_path, capsys):
    shutil.copytree(made.knee, tmp_path / "knee")
    table = json.loads((made.knee / "markers.json").read_text(encoding="utf-8"))
    kept = [row for row, bone in enumerate(table["marker_segment"]) if bone == "femur"]
    few = {key: [values[row] for row in kept] for key, values in table.items()}
    (tmp_path / "knee" / "markers.json").write_text(json.dumps(few), encoding="utf-8")
    words = ["knee", "animate", str(tmp_path / "knee"), str(made.motion), "--reference", str(made.standing)]
    assert run([*words, "--view", "medial", "--out", str(tmp_path / "out"), "-q"]) == NOT_USABLE
    verdict = agreed_verdict(tmp_path / "out" / "run.json", printed=capsys.readouterr().out)
    assert verdict.reasons[0].what.startswith("The tibia is not moved: ")


@pytest.mark.parametrize(("option", "wrong"), ANIMATE_SETTINGS)
def test_impossible_settings_of_an_animation_are_named_and_leave_nothing(made, capsys, option, wrong):
    assert run(["knee", "animate", str(made.knee), str(made.motion), *option]) == WRONG_INPUT
    text = capsys.readouterr().err
    assert "Traceback" not in text
    assert wrong in " ".join(text.split())
    assert not (made.motion / "knee").exists()


def test_an_interrupted_animation_has_its_own_exit_code(made, monkeypatch, tmp_path):
    monkeypatch.setattr("marey.pipelines.knee.animation_results.VideoWriter", interrupt)
    words = ["knee", "animate", str(made.knee), str(made.motion), "--reference", str(made.standing), "-q"]
    assert run([*words, "--view", "plateau", "--out", str(tmp_path / "out")]) == INTERRUPTED


@pytest.mark.slow
@NEEDS_IMAGES
def test_a_template_is_made_and_its_structures_are_printed(tmp_path, capsys):
    grid = made_grid((4.0, 4.0, 4.0))
    write_labels(tmp_path / "mine", made_labels(grid))
    assert run(["knee", "template", str(tmp_path / "mine"), "-q"]) == 0
    out = tmp_path / "mine_template"
    printed = capsys.readouterr()
    assert "knee with femur, tibia, patella\nVerdict: " in printed.out
    assert printed.out.endswith(f"\nTemplate: {out}\n")
    agreed_verdict(out / "run.json", printed=printed.out)
    assert "Note: " in printed.err
    assert (out / "labels.nii.gz").is_file()


def test_outlines_that_cannot_be_a_template_leave_nothing(tmp_path, capsys):
    path = tmp_path / "contours.json"
    write_contours(path, [], VoxelGrid(shape=(4, 5, 6), lps_from_voxel=np.eye(4)), "")
    assert run(["knee", "template", str(path), "--out", str(tmp_path / "out")]) == WRONG_INPUT
    assert "no outlines" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
