"""Writing of trial.toml without losing what is in it."""

import tomllib

import pytest

from marey.errors import FileProblem
from marey.io.trial.trial_file import write_trial_file


@pytest.mark.parametrize(
    "before",
    [
        "",
        "# a\n# b\nc = 1",
        "stature_m = 1.8",
        "# only a comment\n",
        '[world]\nup = "y"\n',
        'a = [\n  [1],\n]\n\n  [world]\nup = "y"\n',
    ],
)
def test_what_is_in_the_file_stays(tmp_path, before):
    path = tmp_path / "trial.toml"
    path.write_text(before)
    write_trial_file(tmp_path, videos={"cam 1": 'a "b".mp4'}, calibration="../c.toml")
    text = path.read_text()
    assert tomllib.loads(text) == tomllib.loads(before) | {
        "calibration": "../c.toml",
        "videos": {"cam 1": 'a "b".mp4'},
    }
    assert all(line in text for line in before.splitlines())


def test_a_new_file_is_written_into_a_new_folder(tmp_path):
    path = write_trial_file(tmp_path / "session" / "walk", videos={"cam01": "x.mp4"})
    assert tomllib.loads(path.read_text()) == {"videos": {"cam01": "x.mp4"}}


def test_keys_that_are_there_are_not_replaced(tmp_path):
    path = tmp_path / "trial.toml"
    path.write_text("[videos]\na = 'b'\n")
    with pytest.raises(FileProblem, match="has videos already"):
        write_trial_file(tmp_path, videos={"cam01": "x.mp4"})
    path.write_text("[videos")
    with pytest.raises(FileProblem, match="is not TOML"):
        write_trial_file(tmp_path, videos={"cam01": "x.mp4"})
    assert path.read_text() == "[videos"
