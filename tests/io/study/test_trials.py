"""The trials that a pattern finds."""

from pathlib import Path

import pytest

from marey.errors import FileProblem
from marey.io.study.settings import StudySettings
from marey.io.study.trials import find_trials


def settings_of(**given) -> StudySettings:
    return StudySettings.model_validate({"steps": [{"command": "markers"}], **given})


def made(folder: Path, *names: str) -> Path:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.mkdir() if name.endswith("/") else path.write_text("")
    return folder


def found(folder: Path, **given):
    return find_trials(folder, settings_of(**given), results=folder / "results")


def test_subject_and_condition_are_read_from_the_path(tmp_path):
    made(tmp_path, "S02/fast_10/", "S01/slow_1/", "S01/static/", "study.toml", "results/S01/slow_1/", ".git/slow_1/")
    trials = found(tmp_path, pattern="{subject}/{condition}_*")
    assert [(t.name, t.subject, t.condition) for t in trials] == [
        ("S01/slow_1", "S01", "slow"), ("S02/fast_10", "S02", "fast"),
    ]  # fmt: skip


def test_files_lose_their_ending_and_excluded_trials_are_left_out(tmp_path):
    made(tmp_path, "S01_walk1.c3d", "S01_walk2.c3d", "S01_static.c3d", "S01_walk1.txt", "study.toml")
    trials = found(tmp_path, pattern="{subject}_*.c3d", exclude=["*_static"])
    assert [(t.name, t.path.name, t.subject) for t in trials] == [
        ("S01_walk1", "S01_walk1.c3d", "S01"), ("S01_walk2", "S01_walk2.c3d", "S01"),
    ]  # fmt: skip


def test_a_field_that_is_repeated_has_one_value_and_a_trial_may_state_its_own(tmp_path):
    made(tmp_path, "S01/S01_a.c3d", "S01/S02_a.c3d", "S02/S02_a.c3d")
    trials = found(
        tmp_path, pattern="{subject}/{subject}_*.c3d", trials={"S02/S02_a": {"condition": "brace", "subject": "S99"}}
    )
    named = [(t.name, t.subject, t.condition) for t in trials]
    assert named == [("S01/S01_a", "S01", ""), ("S02/S02_a", "S99", "brace")]


@pytest.mark.parametrize(
    ("names", "given", "wrong"),
    [
        (["a.txt"], {"pattern": "*.c3d"}, r"has no trials: no folder or file has a path like the pattern '\*.c3d'"),
        (["S1/w.c3d", "S1/w.trc"], {"pattern": "*/*"}, r"has two trials of the name 'S1/w': S1/w.c3d and S1/w.trc"),
        (["S1/w/", "S1/W/"], {"pattern": "*/*"}, r"has two trials of the name"),
        (["a/", "b/"], {"subjects": {"c": {}}}, r"names the subject 'c', which no trial has. There are: a, b"),
        (["a/", "b/"], {"trials": {"c": {}}}, r"names the trial 'c', which no trial has"),
        (["a/", "b/"], {"reference": "slow"}, r"names the condition 'slow', which no trial has"),
        (["a/"], {"pattern": "../*"}, r"has the pattern '../\*'. It should lead into the study"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, names, given, wrong):
    made(tmp_path, *names)
    if len({name.casefold() for name in names}) > len(list(tmp_path.rglob("[wWab]*"))):
        pytest.skip("this file system does not distinguish capitals")
    with pytest.raises(FileProblem, match=wrong):
        found(tmp_path, **given)
