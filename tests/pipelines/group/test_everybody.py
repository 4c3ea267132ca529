"""Everybody in a rendered take of two people: listed, captured one after the other, and nobody taken for the other."""

import csv
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from tests import two_people

import marey
from marey.errors import FileProblem, NotWritten
from marey.fit.regions.region_track import RegionTrack
from marey.pipelines.capture import by_regions, without_plate
from marey.pipelines.group import everybody
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.verdict import Verdict, VerdictReason

FRAMES = 4


@pytest.fixture(scope="module")
def take(tmp_path_factory):
    folder = tmp_path_factory.mktemp("two") / "trial"
    return folder, two_people.write_take(folder, frames=FRAMES, plates=True)


def without_plates(take, folder: Path) -> Path:
    """Link the trial without the images of the empty room."""
    folder.mkdir()
    for path in take[0].iterdir():
        if path.name not in ("background", "marey"):
            (folder / path.name).symlink_to(path)
    return folder


def place(person, frame: int = 3) -> np.ndarray:
    return person.middle(frame)[:2]


@pytest.mark.slow
@pytest.mark.parametrize("given", ["key points", "foreground"])
def test_everybody_is_listed_with_place_height_and_picture(take, tmp_path, given):
    folder, truth = take
    found = marey.list_people(folder, out=tmp_path, keypoints=folder / "pose" if given == "key points" else None)
    assert (len(found), found.source) == (2, given)
    true = [posed[3].segment_origin.mean(0)[:2] for posed in truth]
    for person in found.people:
        assert person.frames == list(range(FRAMES))
        assert min(np.linalg.norm(place(person) - each) for each in true) < 0.15
    assert {round(person.height_m, 1) for person in found.people} <= {1.6, 1.7, 1.8}
    lines = str(found).splitlines()
    assert len(lines) == 3
    assert lines[1].split()[:4] == ["1", "0", "to", "3"]
    for path, camera in zip(found.pictures, two_people.cameras(), strict=True):
        picture = cv2.imread(str(path))
        assert (picture.shape[1], picture.shape[0]) == camera.size
        assert path.name == f"people_{camera.name}.png"


@pytest.mark.slow
def test_everybody_is_listed_by_regions_where_nothing_is_given(take, tmp_path, monkeypatch):
    folder, truth = without_plates(take, tmp_path / "trial"), take[1]
    tracks = []
    for score, people in enumerate(truth, 1):
        shown = {frame: posed.pose for frame, posed in enumerate(people)}
        tracks.append(RegionTrack(people[0].body, shown, dict.fromkeys(shown, float(score)), np.zeros(0)))
    monkeypatch.setattr(by_regions, "_tracked", lambda *args: (tracks, 0, False))
    found = marey.list_people(folder, out=tmp_path / "out")
    assert found.source == "colours and motion"
    assert len(found) == 2
    for person, people in zip(found.people, truth, strict=True):
        np.testing.assert_allclose(person.points[3], people[3].segment_origin, atol=1e-6)
    assert all(path.is_file() for path in found.pictures)


@pytest.mark.slow
def test_two_people_who_do_not_touch_are_both_captured_and_an_interruption_is_resumed(take, tmp_path, monkeypatch):
    folder, truth = without_plates(take, tmp_path / "trial"), take[1]
    capture, numbers = everybody.capture_trial, []

    def until_the_second(trial, settings, progress, **more):
        numbers.append(settings.person)
        if numbers == [1, 2]:
            raise KeyboardInterrupt
        return capture(trial, settings, progress, **more)

    monkeypatch.setattr(everybody, "capture_trial", until_the_second)
    monkeypatch.setattr(without_plate, "MOST_ROUNDS", 2)
    given = {"out": tmp_path / "out", "keypoints": folder / "pose", "overlay": False}
    with pytest.raises(KeyboardInterrupt):
        marey.capture_people(folder, **given)
    found = marey.capture_people(folder, **given)
    assert numbers == [1, 2, 2]
    assert sorted(found.motions) == [1, 2]
    assert found.failures == {}
    used = []
    for number, motion in found.motions.items():
        assert motion.report == tmp_path / "out" / f"person{number}" / "report.html"
        errors = [two_people.joint_errors_of(motion.folder, posed).mean() for posed in truth]
        used.append(int(np.argmin(errors)))
        assert min(errors) < 0.03
    assert sorted(used) == [0, 1]
    with found.summary.open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["person"], row["frames_measured"], row["problem"]) for row in rows] == [("1", "4", ""), ("2", "4", "")]
    assert all(float(row["agreement"]) > 0.6 for row in rows)
    assert not (tmp_path / "out" / ".work").exists()


def test_the_verdict_on_several_people_is_that_of_the_best():
    sound, wrong = (SimpleNamespace(verdict=Verdict.of(each)) for each in ([], [VerdictReason.failure("Wrong.")]))
    assert everybody.people_verdict({1: sound}, {}).level == "good"
    assert everybody.people_verdict({1: sound, 2: wrong}, {3: "Too little."}).texts() == (
        "usable with limits", ["Person 2: Wrong.", "Person 3 was not captured. Too little."]
    )  # fmt: skip
    assert everybody.people_verdict({2: wrong}, {}).texts() == ("not usable", ["Person 2: Wrong."])


def test_a_person_who_cannot_be_captured_does_not_stop_the_others(take, tmp_path, monkeypatch):
    def fails_for_the_first(trial, settings, progress, **more):
        if settings.person == 1:
            raise FileProblem("cam01.mp4", "shows too little", "Try another.")
        raise FileProblem("cam02.mp4", "shows too little", "Try another.")

    monkeypatch.setattr(everybody, "capture_trial", fails_for_the_first)
    progress = RecordingProgress()
    with pytest.raises(marey.MareyError, match=r"cam01.mp4: shows too little\..*cam02.mp4"):
        marey.capture_people(take[0], out=tmp_path, keypoints=take[0] / "pose", progress=progress)
    assert "Person 2 was not captured. cam02.mp4: shows too little. Try another." in progress.warnings


def test_measured_lengths_are_those_of_a_person_who_is_alone_however_the_person_is_named(take):
    trial = everybody.reopened(take[0], {"stature_m": 1.8, "people": {"follow": "1.0,0.5,0@2"}})
    assert everybody._measured_person(trial, 1, RecordingProgress()) == 1


@pytest.mark.slow
@pytest.mark.parametrize(("follow", "whose"), [(None, 1), ("2", 2), ("1.0,0.5,0@2", None)])
def test_measured_lengths_are_those_of_the_followed_person_alone(take, tmp_path, monkeypatch, follow, whose):
    lengths: dict[int, list[float | None]] = {}

    def noted(trial, settings, progress, **more):
        lengths[settings.person] = [getattr(trial.settings, key) for key in everybody.LENGTHS]
        raise FileProblem("cam01.mp4", "shows too little", "Try another.")

    class Reports(RecordingProgress):
        def report(self, text: str) -> None:
            reports.append(text)

    reports: list[str] = []
    monkeypatch.setattr(everybody, "capture_trial", noted)
    people = {} if follow is None else {"people": {"follow": follow}}
    trial = everybody.reopened(take[0], {"stature_m": 1.8, "leg_length_m": 0.93, "asis_distance_m": 0.24, **people})
    with pytest.raises(marey.MareyError, match="shows too little"):
        marey.capture_people(trial, out=tmp_path, keypoints=take[0] / "pose", progress=Reports())
    assert lengths == {number: [1.8, 0.93, 0.24] if number == whose else [None] * 3 for number in (1, 2)}
    who = "nobody: [people] follow is not a number" if whose is None else f"person {whose} alone"
    assert f"Measured lengths (stature, leg length, ASIS distance) are used for {who}." in reports


def test_a_table_of_the_user_is_reported_before_the_work(take, tmp_path, monkeypatch):
    (tmp_path / "people.csv").write_text("my own", encoding="utf-8")
    monkeypatch.setattr(everybody, "listed_people", lambda *_: pytest.fail("the work has begun"))
    with pytest.raises(NotWritten, match="marey did not write what has this name"):
        marey.capture_people(take[0], out=tmp_path, keypoints=take[0] / "pose")
    assert (tmp_path / "people.csv").read_text(encoding="utf-8") == "my own"
