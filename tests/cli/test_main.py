import os
import re
import signal
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from tests.clips import make_trial
from tests.detected import JOINTS, openpose, write_folder

import marey
from marey.__main__ import start
from marey.cli.main import run
from marey.errors import FileProblem
from marey.pipelines.speed.speeds import Speed
from marey.pipelines.verdict import NotUsable, Verdict, VerdictReason

SPEED = Speed(what="pose", measured="2.00 ms", beside="limit [1] ms")


class FakeCapture:
    """Replaces the capture, and does what a test wants."""

    def __init__(self):
        self.calls: list[tuple[Path, dict]] = []
        self.fails: BaseException | None = None

    def __call__(self, folder: Path, **settings) -> SimpleNamespace:
        self.calls.append((folder, settings))
        if self.fails is not None:
            raise self.fails
        return SimpleNamespace(report=settings["out"] / "report.html", verdict=None)


@pytest.fixture
def capture(monkeypatch: pytest.MonkeyPatch) -> FakeCapture:
    fake = FakeCapture()
    monkeypatch.setattr("marey.pipelines.capture.tasks.capture", fake)
    return fake


def test_the_version_is_printed(capsys):
    assert run(["--version"]) == 0
    assert capsys.readouterr().out.strip() == f"marey {marey.__version__}"


def test_help_names_every_command_and_shows_examples(capsys):
    assert run(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(command in text for command in ("capture", "demo", "view", "bench"))
    assert run(["capture", "--help"]) == 0
    assert "marey capture walk01 --stature 1.80" in capsys.readouterr().out


def test_options_reach_the_capture(capture, tmp_path, capsys):
    options = [
        "--cameras",
        "cam01, cam02",
        "--frames",
        "10:20",
        "--stature",
        "1.8",
        "--preset",
        "upper",
        "--keypoints",
        "pose",
        "--no-overlay",
    ]
    assert run(["capture", str(tmp_path), "--out", str(tmp_path / "here"), *options]) == 0
    _, settings = capture.calls[0]
    assert settings["cameras"] == ("cam01", "cam02")
    assert settings["frames"] == (10, 20)
    assert settings["keypoints"] == Path("pose")
    assert (settings["stature"], settings["preset"], settings["overlay"]) == (1.8, "upper", False)
    assert str(tmp_path / "here" / "report.html") in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments",
    [
        ["capture"],
        ["capture", ".", "--stature", "tall"],
        ["capture", ".", "--frames", "10-20"],
        ["capture", ".", "--frames", "20:10"],
        ["capture", ".", "--cameras", ","],
        ["capture", ".", "--colour", "blue"],
        ["capture", "nowhere"],
        ["view", "nowhere", "--no-browser"],
        ["dance"],
    ],
)
def test_wrong_input_is_one_clear_line_and_code_two(arguments, capture, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(arguments) == 2
    shown = capsys.readouterr()
    assert shown.err.startswith("marey: ")
    assert shown.err.count("\n") == 1
    assert not shown.out
    assert not capture.calls
    assert not list(tmp_path.iterdir())


def write_key_points(folder, cameras):
    rng = np.random.default_rng(0)
    people = [[openpose(rng.uniform(0, 48, (len(JOINTS), 2)))] for _ in cameras]
    return write_folder(folder, cameras, [people] * 2)


@pytest.mark.parametrize(
    ("cameras", "name", "line"),
    [
        ((), "none", r"none: does not exist. Correct keypoints \(--keypoints\)."),
        ((), "trial/cam01.mp4", r"cam01.mp4: is not a folder. Correct keypoints \(--keypoints, or"),
        (("left", "right"), "pose", "pose: has key points of none of the cameras cam01, cam02. At least two cameras"),
        (("cam01", "right"), "pose", "pose: has key points only of cam01 of the cameras cam01, cam02. At least"),
        (("cam01", "cam02"), "pose", "pose: has no person about whose joints two cameras agree. Check that the files"),
    ],
    ids=["missing", "a file", "other cameras", "one camera", "no agreement"],
)
def test_key_points_that_cannot_be_used_are_one_line_and_leave_nothing(tmp_path, capsys, cameras, name, line):
    trial = make_trial(tmp_path)
    if cameras:
        write_key_points(tmp_path / "pose", cameras)
    out = tmp_path / "out"
    assert run(["capture", str(trial), "--keypoints", str(tmp_path / name), "--out", str(out), "--quiet"]) == 2
    shown = capsys.readouterr()
    assert re.search(f"^marey: .*{line}", shown.err)
    assert shown.err.count("\n") == 1
    assert not shown.out
    assert not out.exists()


def test_a_file_problem_names_file_fault_and_remedy(capture, tmp_path, capsys):
    capture.fails = FileProblem("cameras.toml", "has no camera 'cam03'", "Calibrate it,\nor leave it away.")
    assert run(["capture", str(tmp_path)]) == 2
    line = "marey: cameras.toml: has no camera 'cam03'. Calibrate it, or leave it away.\n"
    assert capsys.readouterr().err == line


def test_the_commands_on_a_trial_print_the_path_of_their_result(tmp_path, capsys, monkeypatch):
    given = {}

    def called(name):
        def call(trial, **settings):
            given[name] = (trial, settings)
            return SimpleNamespace(
                path=settings["out"] / "surface.npz", report=settings["out"] / "report.html", verdict=Verdict()
            )

        return call

    monkeypatch.setattr("marey.pipelines.surface.tasks.measure_surface", called("surface"))
    monkeypatch.setattr("marey.pipelines.shape.tasks.fit_shape", called("shape"))
    options = ["--keep-rig", "--no-tracks", "--max-speed", "2", "--frames", ":3"]
    assert run(["surface", str(tmp_path), *options]) == 0
    out = tmp_path / "marey"
    printed = f"Verdict: good\nSurface: {out / 'surface.npz'}\nReport: {out / 'report.html'}\n"
    assert capsys.readouterr().out == printed
    settings = given["surface"][1]
    assert (settings["refine_rig"], settings["tracks"], settings["max_speed"], settings["frames"]) == (
        False, False, 2.0, (0, 3),
    )  # fmt: skip
    assert run(["shape", str(tmp_path), "--out", str(tmp_path / "own"), "--preset", "right_arm"]) == 0
    assert capsys.readouterr().out == f"Verdict: good\nReport: {tmp_path / 'own' / 'report.html'}\n"
    assert given["shape"][1]["preset"] == "right_arm"


def test_an_interrupted_run_names_the_way_to_resume_it(capture, tmp_path, capsys):
    capture.fails = KeyboardInterrupt()
    assert run(["capture", str(tmp_path)]) == 130
    assert "same command" in capsys.readouterr().err


def test_an_error_that_a_signal_causes_is_an_interruption(monkeypatch, tmp_path, capsys):
    def imported(folder: Path, **settings: object) -> None:
        # The initialisation of a module that is not written in Python replaces any error by one of its own.
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            threading.Event().wait(20)
        except KeyboardInterrupt as error:
            raise ImportError("initialization failed") from error

    monkeypatch.setattr("marey.pipelines.capture.tasks.capture", imported)
    assert run(["capture", str(tmp_path)]) == 143
    assert capsys.readouterr().err == "\nTerminated. Run the same command again to resume.\n"


def test_before_and_after_the_work_a_signal_ends_the_program_at_once(monkeypatch):
    before, seen = signal.getsignal(signal.SIGINT), []
    monkeypatch.setattr("marey.cli.main.main", lambda: seen.append(signal.getsignal(signal.SIGINT)))
    try:
        for handler in (signal.default_int_handler, signal.SIG_IGN):
            signal.signal(signal.SIGINT, handler)
            start()
    finally:
        signal.signal(signal.SIGINT, before)
    assert seen == [signal.SIG_DFL, signal.SIG_IGN]


@pytest.mark.parametrize(
    ("words", "command"),
    [("capture a --stature", "capture"), ("knee segment a --side", "knee segment"), ("knee", "knee"), ("-q", "")],
)
def test_a_fault_of_the_words_names_the_help_of_the_command(words, command, capsys):
    assert run(words.split()) == 2
    assert capsys.readouterr().err.endswith(f" See {' '.join(['marey', *command.split()])} --help.\n")


def test_a_full_disk_is_reported_in_one_line_but_an_error_of_the_program_keeps_its_traceback(capture, tmp_path, capsys):
    capture.fails = OSError(28, "No space left on device", str(tmp_path / "motion.npz"))
    assert run(["capture", str(tmp_path)]) == 2
    assert "motion.npz: No space left on device" in capsys.readouterr().err
    capture.fails = ZeroDivisionError("in the solver")
    with pytest.raises(ZeroDivisionError):
        run(["capture", str(tmp_path)])


@pytest.mark.parametrize("page", ["report.html", "marey/report.html", "surface.html", "knee.html", "knee/knee.html"])
def test_view_prints_the_path_of_the_report(page, tmp_path, capsys):
    (tmp_path / page).parent.mkdir(exist_ok=True)
    (tmp_path / page).write_text("<html>")
    assert run(["view", str(tmp_path), "--no-browser"]) == 0
    assert capsys.readouterr().out.strip() == str((tmp_path / page).resolve())


def test_a_missing_argument_is_reported_with_the_help_of_its_own_command(capsys):
    assert run(["knee", "animate", "folder"]) == 2
    assert capsys.readouterr().err == "marey: Missing argument 'MOTION'. See marey knee animate --help.\n"


def test_the_demo_captures_the_example_of_the_clone_in_its_own_folder(capture, capsys):
    assert run(["demo", "--quiet"]) == 0
    folder, settings = capture.calls[0]
    assert (folder / "cam04.mp4").is_file()
    assert settings["out"] == folder / "marey"


def test_the_demo_of_an_installed_program_writes_to_the_current_folder(capture, tmp_path, monkeypatch):
    example = tmp_path / "share" / "marey" / "examples" / "reach"
    example.mkdir(parents=True)
    (example / "cameras.toml").touch()
    monkeypatch.setattr(marey, "__file__", str(tmp_path / "lib" / "site" / "marey" / "__init__.py"))
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    assert run(["demo"]) == 0
    assert capture.calls[0][0] == example
    assert capture.calls[0][1]["out"] == Path("marey-demo")


def test_bench_prints_a_table_of_the_machine_and_every_speed(capsys, monkeypatch):
    monkeypatch.setattr("marey.pipelines.speed.speeds.measure_speeds", lambda *given, **more: [SPEED])
    assert run(["bench"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "cores" in shown
    assert "pose 2.00 ms limit [1] ms" in shown


def test_a_run_without_a_usable_answer_ends_with_its_verdict_and_code_3(monkeypatch, tmp_path, capsys):
    def capture(trial, **settings):
        reason = VerdictReason(level="not usable", what="All calibrations are equal.", remedy="Correct the file.")
        raise NotUsable(Verdict.of([reason]), tmp_path / "report.html")

    monkeypatch.setattr("marey.pipelines.capture.tasks.capture", capture)
    assert run(["capture", str(tmp_path)]) == 3
    last = capsys.readouterr().err.splitlines()[-3:]
    assert last[0] == "Verdict: not usable"
    assert last[1] == "- All calibrations are equal. Correct the file."
    assert last[2].endswith("report.html")


@pytest.mark.parametrize(("level", "code"), [("good", 0), ("usable with limits", 0), ("not usable", 3)])
def test_the_exit_code_of_a_capture_is_that_of_its_verdict(monkeypatch, tmp_path, capsys, level, code):
    verdict = Verdict.of([VerdictReason(level=level, what="Something was found.")])
    found = SimpleNamespace(report=tmp_path / "report.html", verdict=verdict)
    monkeypatch.setattr("marey.pipelines.capture.tasks.capture", lambda trial, **settings: found)
    assert run(["capture", str(tmp_path)]) == code
    shown = capsys.readouterr().out.splitlines()
    assert shown[:2] == [f"Verdict: {level}", "- Something was found."]
    assert shown[2].startswith("Report: ")


@pytest.mark.parametrize(("option", "last"), [(["--people", "all"], "Summary: "), (["--list-people"], "Verdict: ")])
def test_a_capture_of_several_people_ends_with_one_verdict(monkeypatch, tmp_path, capsys, option, last):
    people = SimpleNamespace(pictures=[tmp_path / "people_cam01.png"], verdict=Verdict())
    motions = {number: SimpleNamespace(report=tmp_path / f"person{number}" / "report.html") for number in (1, 2)}
    found = SimpleNamespace(people=people, motions=motions, summary=tmp_path / "people.csv", verdict=Verdict())
    monkeypatch.setattr("marey.pipelines.capture.tasks.reopened", lambda trial, changes: trial)
    monkeypatch.setattr("marey.pipelines.group.everybody.captured_people", lambda *given: found)
    monkeypatch.setattr("marey.pipelines.group.listing.listed_people", lambda *given: people)
    assert run(["capture", str(tmp_path), *option]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines.count("Verdict: good") == 1
    assert lines[-1].startswith(last)
    reports = [line for line in lines if line.startswith("Report of person ")]
    assert len(reports) == (2 if "--people" in option else 0)
