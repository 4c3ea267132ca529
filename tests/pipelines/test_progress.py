from contextlib import contextmanager

import pytest

from marey.pipelines.progress import Progress, RecordingProgress, readable_seconds


def test_the_recording_progress_fulfils_the_protocol_and_shows_nothing(capfd):
    progress: Progress = RecordingProgress()
    with progress.stage("Start", 3) as step:
        step()
    progress.report("hello")
    progress.warn("cam02 is dark")
    assert progress.warnings == ["cam02 is dark"]
    assert capfd.readouterr() == ("", "")


def test_two_recordings_share_nothing():
    first = RecordingProgress()
    first.warn("cam02 is dark")
    assert RecordingProgress().warnings == []


def test_times_of_a_stage_add_up_even_when_it_fails():
    progress = RecordingProgress()
    with pytest.raises(ValueError, match="no"), progress.stage("Start"):
        raise ValueError("no")
    first = progress.timings["Start"]
    with progress.stage("Start"):
        pass
    assert progress.timings["Start"] >= first


def test_durations_are_readable():
    durations = {4.23: "4.2 s", 59.99: "1 min 00 s", 200: "3 min 20 s", 3900: "1 h 05 min"}
    assert {s: readable_seconds(s) for s in durations} == durations


def test_the_finished_share_of_a_stage_is_reported_in_hundredths(monkeypatch):
    steps = []
    progress = RecordingProgress()

    @contextmanager
    def counted(name, total):
        steps.append((name, total))
        yield steps.append

    monkeypatch.setattr(progress, "_counted", counted)
    with progress.stage_of_shares("Bones") as done:
        done(0.25)
        done(0.25)
        done(0.31)
        done(1.0)
    assert steps == [("Bones", 100), 25, 6, 69]


def test_the_steps_of_a_stage_are_timed_beside_it():
    progress = RecordingProgress()
    with progress.stage_of_steps("Bones") as begin:
        begin("growing", 0.0)
        begin("edges", 0.5)
        begin("edges", 0.8)
    assert list(progress.timings) == ["Bones"]
    assert list(progress.steps["Bones"]) == ["growing", "edges"]
    assert 0 < sum(progress.steps["Bones"].values()) <= progress.timings["Bones"]
