"""`marey retarget` from the command line."""

import pytest
from tests import performer, rigs
from tests.io.gltf.test_rig import segments

from marey.cli.main import run
from marey.io.npz import write_motion
from marey.io.results.body import write_body


@pytest.fixture
def folder(tmp_path):
    person = performer.body()
    out = tmp_path / "trial" / "marey"
    out.mkdir(parents=True)
    write_motion(out / "motion.npz", performer.motion(person))
    write_body(out / "body.npz", person, preset="full")
    rigs.write_rig(tmp_path / "knight.glb", rigs.MIXAMO, segments(rigs.MIXAMO), unit=0.01)
    return tmp_path


def test_the_copy_lies_beside_the_motion_and_the_joints_are_reported(folder, capsys):
    assert run(["retarget", str(folder / "trial"), str(folder / "knight.glb")]) == 0
    text = capsys.readouterr().out
    assert "left_thigh = mixamorig:LeftUpLeg" in text
    assert "There is no result at" in text
    assert (folder / "trial" / "marey" / "knight_retargeted.glb").is_file()


def test_a_file_alone_and_a_place_for_the_copy_may_be_given(folder, capsys):
    motion = folder / "trial" / "marey" / "motion.npz"
    arguments = ["retarget", str(motion), str(folder / "knight.glb"), "--out", str(folder / "new" / "a.glb"), "-q"]
    assert run([*arguments, "--no-ground"]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("Verdict: usable with limits\n- There is no result at ")
    assert printed.endswith(f"\nWritten: {folder / 'new' / 'a.glb'}\n")


def test_twist_joints_and_planted_feet_are_reported(folder, capsys):
    rigs.write_rig(folder / "ranger.glb", rigs.UNREAL_5, segments(rigs.UNREAL_5))
    assert run(["retarget", str(folder / "trial"), str(folder / "ranger.glb"), "--plant-feet"]) == 0
    text = capsys.readouterr().out
    assert "lowerarm_twist_01_l 0.7" in text
    assert "Feet: " in text


@pytest.mark.parametrize(
    ("arguments", "wrong"),
    [
        (["nowhere", "knight.glb"], "does not exist"), (["new", "knight.glb"], "holds no motion.npz"),
        (["trial", "none.glb"], "No such file"), (["trial", "knight.glb", "--map", "m.toml"], "m.toml"),
        (["trial", "knight.glb", "--out", "knight.glb"], "the character itself"),
        (["trial", "knight.glb", "--out", "a.fbx"], "has the suffix .fbx"),
        (["trial", "knight.glb", "--out", "knight.glb/a.glb"], "knight.glb/a.glb: cannot be written"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_named(folder, capsys, monkeypatch, arguments, wrong):
    monkeypatch.chdir(folder)
    (folder / "new").mkdir()
    assert run(["retarget", *arguments]) == 2
    assert wrong in capsys.readouterr().err
