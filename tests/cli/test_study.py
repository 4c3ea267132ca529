"""`marey study`: options, printed text, exit codes, and bad input."""

import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.studies import write_study
from tests.verdicts import agreed_verdict

from marey.cli.main import WRONG_INPUT, run
from marey.io.study.records import read_step_record
from marey.pipelines.study import cluster, study

distributed = pytest.importorskip("distributed", reason="studies need the packages of the extra `study`")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A study of one trial, in the current folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cluster, "CONNECT_S", 0.5)
    return write_study(tmp_path / "gait", subjects=1)


def refused(folder: Path, words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Run `marey study` with bad input, and return the one line that it writes."""
    before = sorted(folder.rglob("*"))
    assert run(["study", "gait", *words]) == WRONG_INPUT
    printed = capsys.readouterr()
    assert printed.out == ""
    (line,) = printed.err.splitlines()
    assert line.startswith("marey: ")
    assert sorted(folder.rglob("*")) == before
    return line


def with_toml(folder: Path, text: str) -> None:
    (folder / "study.toml").write_text(text)


STEP = '[[steps]]\ncommand = "markers"\n'


@pytest.mark.parametrize(
    ("toml", "wrong", "right"),
    [
        (f'pattern = "{{subject}}/fast_*.c3d"\n{STEP}', "gait: has no trials", "Correct the pattern"),
        ('pattern = "*/*.c3d"\n', "study.toml: has no steps", "[[steps]]"),
        ("", "study.toml: has no steps", "A short one is"),
        (f'patern = "*/*.c3d"\n{STEP}', "has the unknown key 'patern'", "The known keys are pattern"),
        (f"{STEP}clustres = 3\n", "has the unknown key 'steps.1.clustres'", "A step markers has the keys"),
        ('[[steps]]\ncommand = "walk"\n', "whose command should be capture, surface, shape or markers", "A short one"),
        (f'{STEP}reference = "{{person}}.npz"\n', "{person}", "{subject}"),
        (f'pattern = "../*.c3d"\n{STEP}', "has the pattern '../*.c3d'", "It should lead into the study."),
        (f'pattern = "*/*.c3d"\n{STEP}[subjects.S09]\nside = "left"\n', "'S09'", "There are: S01."),
        ('pattern = "*/*.c3d\n', "study.toml", ""),
    ],
)
def test_a_study_toml_that_cannot_be_used_is_one_line(folder, capsys, toml, wrong, right):
    with_toml(folder, toml)
    line = refused(folder, [], capsys)
    assert wrong in line
    assert right in line


def test_an_empty_study_is_one_line(folder, capsys):
    shutil.rmtree(folder / "S01")
    line = refused(folder, [], capsys)
    assert "gait: has no trials: no folder or file has a path like the pattern" in line


def test_a_folder_without_settings_and_one_that_is_missing_are_one_line(folder, capsys):
    (folder / "study.toml").unlink()
    assert "study.toml: does not exist. A short one is: " in refused(folder, [], capsys)
    shutil.rmtree(folder)
    folder.write_text("")
    assert "gait" in refused(folder, [], capsys)
    folder.unlink()
    assert "gait" in refused(folder, [], capsys)


def test_two_trials_of_one_name_are_one_line_that_names_both(folder, capsys):
    shutil.copy(folder / "S01" / "slow_1.c3d", folder / "S01" / "slow_1.trc")
    with_toml(folder, f'pattern = "{{subject}}/{{condition}}_*"\n{STEP}')
    line = refused(folder, [], capsys)
    assert "has two trials of the name 'S01/slow_1': S01/slow_1.c3d and S01/slow_1.trc. Rename one of them" in line


@pytest.mark.parametrize(
    ("words", "wrong"),
    [
        (["--workers", "0"], "workers (--workers) is 0; it should be at least 1."),
        (["--workers", "two"], "'--workers'"),
        (["--memory", "0.01"], "memory (--memory) is 0.01 GB"),
        (["--memory", "nan"], "memory (--memory) is nan GB"),
        (["--scheduler", "tcp://127.0.0.1:1"], "No scheduler answers at tcp://127.0.0.1:1 (--scheduler). Start one"),
        (["--scheduler", "nonsense"], "No scheduler answers at nonsense"),
        (["--scheduler", "tcp://127.0.0.1:1", "--memory", "2"], "leave out --workers and --memory"),
        (["--out", "gait/study.toml"], "gait/study.toml"),
        (["--threads", "2"], "--threads"),
    ],
)
def test_options_that_cannot_be_used_are_one_line(folder, capsys, words, wrong):
    assert wrong in refused(folder, words, capsys)


def test_all_options_reach_the_pipeline(folder, monkeypatch):
    given: dict[str, Any] = {}

    def recorded(root: Path, **options: Any) -> Any:
        given.update(options, root=root)
        raise KeyboardInterrupt

    monkeypatch.setattr(study, "run_study", recorded)
    assert run(["study", "gait", "--workers", "3", "--memory", "2.5", "--out", "there", "-q"]) == 130
    del given["progress"]
    assert given == {"root": Path("gait"), "workers": 3, "memory_gb": 2.5, "scheduler": None, "out": Path("there")}
    assert run(["study", "gait", "--scheduler", "tcp://node01:8786", "-q"]) == 130
    assert given["scheduler"] == "tcp://node01:8786"


@pytest.fixture
def lonely_scheduler() -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """The address of a scheduler with one worker, and its process."""
    with subprocess.Popen(
        [sys.executable, "-c", "from tests.cli.test_study import serve; serve()"], stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        yield process.stdout.readline().decode().strip(), process
        process.kill()


def serve() -> None:
    """Serve a scheduler until this process is killed, and print its address."""
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address=None, worker_dashboard_address=None
    ) as served:
        print(served.scheduler_address, flush=True)
        time.sleep(600)


@pytest.mark.slow
def test_a_scheduler_that_ends_is_one_line_and_the_study_resumes(tmp_path, monkeypatch, capsys, lonely_scheduler):
    monkeypatch.chdir(tmp_path)
    folder, (address, process) = write_study(tmp_path / "gait", subjects=4), lonely_scheduler
    records = [folder / "results" / f"S{k:02d}" / "slow_1" / "markers.json" for k in range(1, 5)]
    ending = threading.Thread(target=end_after_the_first, args=(records, process))
    ending.start()
    assert run(["study", "gait", "--scheduler", address, "-q"]) == WRONG_INPUT
    ending.join()
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"marey: The scheduler at {address} has ended, or the connection to it was lost.")
    done = {path: path.read_bytes() for path in records if is_done(path)}
    assert 0 < len(done) < 4
    assert run(["study", "gait", "--workers", "1", "-q"]) == 0
    agreed_verdict(folder / "results" / "run.json", printed=capsys.readouterr().out, page=folder / "results/study.html")
    assert {path: path.read_bytes() for path in done} == done


def is_done(path: Path) -> bool:
    record = read_step_record(path)
    return record is not None and record.state == "done"


def end_after_the_first(records: list[Path], process: subprocess.Popen[bytes]) -> None:
    """Kill a scheduler when the first step is done."""
    end = time.monotonic() + 60
    while time.monotonic() < end and not any(map(is_done, records)):
        time.sleep(0.01)
    process.kill()
