"""The whole way on a few frames of the example take, and every way in which its input may be wrong."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from marey.cli.main import run
from marey.geometry.rigid import RigidTransform
from marey.geometry.rotations import exp
from marey.io.calibration.readers import read_rig, write_cameras_toml
from marey.io.trial.masks import write_masks
from marey.pipelines.capture import capture

EXAMPLE = Path(__file__).parents[2] / "examples" / "reach"
EMPTY = 10
"""Leading frames without a person, which the truth leaves out."""


@pytest.fixture
def trial(tmp_path: Path) -> Path:
    folder = tmp_path / "reach"
    shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("truth", "README.md", "marey"))
    return folder


def truth() -> tuple[list[str], np.ndarray]:
    with np.load(EXAMPLE / "truth" / "truth.npz") as stored:
        sides = {"l": "left", "r": "right"}
        parts = [str(name).split("_") for name in stored["joint_names"]]
        return ["_".join([sides.get(first, first), *rest]) for first, *rest in parts], stored["joints"]


def give_silhouettes(trial: Path) -> None:
    with np.load(EXAMPLE / "truth" / "masks.npz") as stored:
        cameras, frames, height, width = map(int, stored["shape"])
        masks = np.unpackbits(stored["bits"])[: stored["shape"].prod()].reshape(stored["shape"]).astype(bool)
    (trial / "masks").mkdir()
    for c in range(cameras):
        empty: list = [None] * EMPTY
        shape = (EMPTY + frames, height, width)
        write_masks(trial / "masks" / f"cam{c + 1:02}.npz", [*empty, *masks[c]], shape=shape)


def give_start(trial: Path, frame: int) -> Path:
    names, joints = truth()
    clicks: dict = {"frame": frame}
    limbs = [i for i, name in enumerate(names) if name.startswith(("left", "right"))]
    for camera in read_rig(trial / "cameras.toml"):
        pixels = camera.project(joints[frame - EMPTY])
        clicks[camera.name] = {names[i]: pixels[i].round(1).tolist() for i in limbs}
    path = trial / "clicks.json"
    path.write_text(json.dumps(clicks))
    return path


def interrupt(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def not_again(*_: object, **__: object) -> None:
    raise AssertionError("this was done before the interruption")


def test_known_silhouettes_and_clicked_joints_give_a_motion_near_the_truth(trial, capsys, monkeypatch):
    give_silhouettes(trial)
    clicks = give_start(trial, 43)
    out = trial.parent / "results"
    options = ["--frames", "40:46", "--start", str(clicks), "--no-overlay", "--quiet", "--out", str(out)]
    with monkeypatch.context() as patch:
        patch.setattr(capture, "write_capture", interrupt)
        assert run(["capture", str(trial), *options]) == 130
    assert [path.name for path in out.iterdir()] == [".work"]
    monkeypatch.setattr(capture, "track_person", not_again)
    monkeypatch.setattr(capture, "begin", not_again)
    monkeypatch.setattr("marey.fit.recipes.track._mend", not_again)
    monkeypatch.setattr("marey.fit.recipes.sequence._Work._part", not_again)
    assert run(["capture", str(trial), *options]) == 0, capsys.readouterr().err
    names, joints = truth()
    with np.load(out / "motion.npz") as motion:
        assert motion["state"].tolist() == [0] * 40 + [1] * 6 + [0] * 84
        limbs = [i for i, n in enumerate(motion["joint_names"]) if n.endswith(("knee", "elbow", "ankle", "wrist"))]
        found = motion["joint_centres"][40:46, limbs]
        wanted = joints[40 - EMPTY : 46 - EMPTY, [names.index(str(motion["joint_names"][i])) for i in limbs]]
    # A body of unknown shape from six frames: what matters here is that all parts work together.
    assert np.linalg.norm(found - wanted, axis=2).mean() < 0.03
    expected = "angles.csv angles.mot body.glb body.npz body.osim joint_centres.trc masks motion.bvh motion.c3d"
    expected += " motion.nc motion.npz orientations.sto report.html run.json skin.npz surface_masks"
    assert sorted(path.name for path in out.iterdir()) == expected.split()


def lose_a_video(trial: Path) -> str:
    (trial / "cam03.mp4").unlink()
    return "has no video of 'cam03'"


def shorten_a_video(trial: Path) -> str:
    content = (trial / "cam02.mp4").read_bytes()
    (trial / "cam02.mp4").write_bytes(content[: len(content) // 2])
    return "cam02.mp4"


def spoil_the_lens(trial: Path) -> str:
    path = trial / "cameras.toml"
    path.write_text(path.read_text().replace("distortions = [ 0.0, 0.0, 0.0, 0.0]", "distortions = [0.1, 0.2, 0.3]", 1))
    return "3 lens numbers"


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


@pytest.mark.parametrize(
    "spoil",
    [lose_a_video, shorten_a_video, spoil_the_lens, add_an_unknown_key, keep_the_empty_frames, turn_the_world],
    ids=lambda spoil: spoil.__name__,
)
def test_wrong_input_is_one_line_with_code_two_and_leaves_nothing(trial, spoil, capsys):
    expected = spoil(trial)
    assert run(["capture", str(trial), "--quiet"]) == 2
    shown = capsys.readouterr()
    lines = [line for line in shown.err.splitlines() if not line.startswith("Note:")]
    assert len(lines) == 1
    assert lines[0].startswith("marey: ")
    assert expected in lines[0]
    assert not shown.out
    assert not (trial / "marey").exists()
