"""The whole way on a few frames of the example take, and every way in which its input may be wrong."""

import json
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from tests.pipelines.capture.reach import EMPTY, copy_half_trial, give_silhouettes, give_start, truth

from marey.errors import FileProblem
from marey.geometry.rigid import RigidTransform
from marey.geometry.rotations import exp
from marey.io.calibration.readers import read_rig, write_cameras_toml
from marey.pipelines.capture import begun, capture, tasks
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.verdict import NotUsable


@pytest.fixture
def trial(tmp_path: Path) -> Path:
    return copy_half_trial(tmp_path / "reach")


def interrupt(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def not_again(*_: object, **__: object) -> None:
    raise AssertionError("this was done before the interruption")


@pytest.mark.slow
def test_known_silhouettes_and_clicked_joints_give_a_motion_near_the_truth(trial, monkeypatch):
    give_silhouettes(trial)
    (trial / "trial.toml").write_text("mass_kg = 72\n")
    clicks = give_start(trial, 43)
    out = trial.parent / "results"
    settings = {"frames": range(40, 44), "start": clicks, "overlay": False, "out": out}
    with monkeypatch.context() as patch:
        patch.setattr(capture, "write_capture", interrupt)
        with pytest.raises(KeyboardInterrupt):
            tasks.capture(trial, **settings)
    assert [path.name for path in out.iterdir()] == [".work"]
    monkeypatch.setattr(begun, "track_person", not_again)
    monkeypatch.setattr(begun, "begin", not_again)
    monkeypatch.setattr("marey.fit.recipes.track._repair_frame", not_again)
    monkeypatch.setattr("marey.fit.recipes.sequence.window_terms", not_again)
    tasks.capture(trial, **settings)
    names, joints = truth()
    with np.load(out / "motion.npz") as motion:
        assert motion["state"].tolist() == [0] * 40 + [1] * 4 + [0] * 86
        limbs = [i for i, n in enumerate(motion["joint_names"]) if n.endswith(("knee", "elbow", "ankle", "wrist"))]
        found = motion["joint_centres"][40:44, limbs]
        wanted = joints[40 - EMPTY : 44 - EMPTY, [names.index(str(motion["joint_names"][i])) for i in limbs]]
    # A body of unknown shape from four frames: what matters here is that all parts work together.
    assert np.linalg.norm(found - wanted, axis=2).mean() < 0.03
    expected = "angles.csv angles.mot body.glb body.npz body.osim joint_centres.trc masks motion.bvh motion.c3d"
    expected += " motion.nc motion.npz orientations.sto report.html run.json skin.npz surface_masks"
    assert sorted(path.name for path in out.iterdir()) == expected.split()
    masses = [float(mass.text) for mass in ElementTree.parse(out / "body.osim").iter("mass")]
    assert sum(masses) == pytest.approx(72, rel=1e-3)


def lose_a_video(trial: Path) -> str:
    (trial / "cam03.mp4").unlink()
    return "has no video of 'cam03'"


def shorten_a_video(trial: Path) -> str:
    content = (trial / "cam02.mp4").read_bytes()
    (trial / "cam02.mp4").write_bytes(content[: len(content) // 2])
    return "cam02.mp4"


def spoil_the_lens(trial: Path) -> str:
    path = trial / "cameras.toml"
    text, count = re.subn(r"distortions = \[.*\]", "distortions = [0.1, 0.2, 0.3]", path.read_text(), count=1)
    assert count == 1
    path.write_text(text)
    return "3 distortion coefficients"


def add_an_unknown_key(trial: Path) -> str:
    (trial / "trial.toml").write_text("statur_m = 1.8\n")
    return "unknown key 'statur_m'"


def keep_the_empty_frames(trial: Path) -> str:
    (trial / "trial.toml").write_text("frames = [0, 6]\n")
    return "shows no person"


def turn_the_world(trial: Path) -> str:
    give_silhouettes(trial)
    give_start(trial, 43)
    (trial / "trial.toml").write_text('frames = [40, 46]\n[start]\nfile = "clicks.json"\n')
    # World y becomes z: rotation' = rotation R', with R' = a quarter turn about x.
    rig = read_rig(trial / "cameras.toml")
    quarter = RigidTransform(exp(np.array([np.pi / 2, 0, 0])), np.zeros(3))
    write_cameras_toml(rig.moved(quarter), trial / "cameras.toml")
    return "[world] up"


@pytest.mark.slow
@pytest.mark.parametrize(
    "spoil",
    [lose_a_video, shorten_a_video, spoil_the_lens, add_an_unknown_key],
    ids=lambda spoil: spoil.__name__,
)
def test_wrong_input_is_named_and_leaves_nothing(trial, spoil):
    expected = spoil(trial)
    with pytest.raises(FileProblem) as caught:
        tasks.capture(trial, out=trial / "marey", progress=RecordingProgress())
    assert expected in str(caught.value)
    assert not (trial / "marey").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "cause"), [(keep_the_empty_frames, "nobody"), (turn_the_world, "vertical axis")], ids=["nobody", "lying"]
)
def test_a_take_that_shows_nobody_or_lies_on_its_side_ends_with_a_verdict_and_its_page(trial, spoil, cause):
    expected, out = spoil(trial), trial / "marey"
    with pytest.raises(NotUsable) as caught:
        tasks.capture(trial, out=out, progress=RecordingProgress())
    [reason] = caught.value.verdict.reasons
    assert (reason.level, reason.cause) == ("not usable", cause)
    assert expected in f"{reason.what} {reason.remedy}"
    assert caught.value.report == out / "report.html"
    assert json.loads((out / "run.json").read_text(encoding="utf-8"))["verdict"]["level"] == "not usable"
