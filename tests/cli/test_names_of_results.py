"""Files of the user that have the names of results are reported before the work, and stay as they are."""

from pathlib import Path

import numpy as np
import pytest

from marey.cli.main import run
from marey.io.opensim.trc import PointPaths, write_trc

OWN = "a table of my own\n"


@pytest.fixture
def session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a file of markers, and one of results that holds files of the user."""
    monkeypatch.chdir(tmp_path)
    points = np.random.default_rng(0).normal(size=(30, 3, 3))
    write_trc(Path("walk.trc"), PointPaths(names=("A", "B", "C"), time=np.arange(30) / 30, rate=30.0, points=points))
    Path("out").mkdir()
    return tmp_path


@pytest.mark.parametrize(
    ("command", "name"),
    [
        ("compare walk.trc walk.trc", "compare.csv"),
        ("compare walk.trc walk.trc", "report.html"),
        ("device walk.trc walk.trc", "clock.json"),
        ("knee template labels.nii.gz", "labels.nii.gz"),
        ("calibrate . --from-keypoints joints", "cameras.toml"),
    ],
)
def test_a_file_of_the_user_is_not_replaced(session, capsys, command, name):
    (session / "out" / name).write_text(OWN, encoding="utf-8")
    (session / "trial.toml").write_text("", encoding="utf-8")
    assert run([*command.split(), "--out", "out"]) == 2
    error = capsys.readouterr().err
    assert f"marey: out/{name}: cannot be written (marey did not write what has this name). Rename it" in error
    assert (session / "out" / name).read_text(encoding="utf-8") == OWN
