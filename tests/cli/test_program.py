"""The program as a process: `python -m marey`, signals, and paths that no report could contain."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from marey.cli import main
from marey.cli.main import run


def test_the_program_runs_as_a_module():
    done = subprocess.run([sys.executable, "-m", "marey", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("marey ")


@pytest.fixture
def endless(monkeypatch):
    """A capture that works until it is interrupted, or for a minute."""
    started = threading.Event()

    def work(*_, **__):
        started.set()
        for _ in range(6000):
            time.sleep(0.01)

    monkeypatch.setattr("marey.pipelines.capture.tasks.capture", work)
    return started


@pytest.fixture
def heeded_interrupts():
    """Ctrl-C as usual: a shell that runs the tests in the background lets them ignore it, as the program then does."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.skipif(os.name != "posix", reason="Windows has no such signals")
@pytest.mark.parametrize(("number", "code", "how"), [("SIGTERM", 143, "Terminated"), ("SIGINT", 130, "Interrupted")])
def test_a_signal_ends_a_run_in_order(endless, heeded_interrupts, tmp_path, capsys, number, code, how):
    before = signal.getsignal(signal.SIGTERM)
    sender = threading.Thread(target=lambda: endless.wait(20) and os.kill(os.getpid(), getattr(signal, number)))
    sender.start()
    assert run(["capture", str(tmp_path), "--quiet"]) == code
    sender.join()
    assert capsys.readouterr().err == f"\n{how}. Run the same command again to resume.\n"
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize(
    "arguments", [["capture", "a\udcff"], ["capture", ".", "--body", "a\udcff"], ["compare", "a", "b\udcff"]]
)
def test_a_path_that_is_not_unicode_is_refused_before_the_work(arguments, capsys):
    assert run(arguments) == 2
    assert f"marey: The argument {arguments[-1]!a} is not valid UTF-8. Rename" in capsys.readouterr().err


def test_a_current_folder_that_is_not_unicode_is_refused(monkeypatch, capsys):
    monkeypatch.setattr(main.os, "getcwd", lambda: "/made/a\udcff")
    assert run(["capture", "."]) == 2
    assert r"The current folder '/made/a\udcff' is not valid UTF-8. Rename it." in capsys.readouterr().err
    assert run(["--version"]) == 0


@pytest.mark.parametrize("command", ["capture", "markers", "view", "sync", "cameras"])
@pytest.mark.parametrize("path", ["x" * 300, "y/" * 2500])
def test_a_path_that_is_too_long_is_one_short_line(command, path, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run([command, path, *(["--quiet"] if command == "markers" else [])]) == 2
    line = capsys.readouterr().err
    assert line.startswith("marey: ")
    assert line.count("\n") == 1
    assert not list(tmp_path.iterdir())
