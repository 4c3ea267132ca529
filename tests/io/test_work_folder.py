import json
import os
import signal
import socket
import subprocess
import sys
import threading

import pytest

from marey.errors import FileProblem
from marey.io.work_folder import WorkFolder

HOLD = """
import sys, time
from pathlib import Path
from marey.io.work_folder import WorkFolder
work = WorkFolder(Path(sys.argv[1]))
(work.path / "stage.npz").write_text("half")
print("held", flush=True)
time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that uses the folder."""
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"held\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_a_folder_in_use_is_an_error_that_names_the_other_run_and_changes_nothing(tmp_path, holder):
    with pytest.raises(FileProblem) as error:
        WorkFolder(tmp_path)
    text = str(error.value)
    assert f"{tmp_path}: is in use by another run of marey (process {holder.pid}, on {socket.gethostname()}" in text
    assert "command -c" in text
    assert "Wait until it has ended, or give another folder" in text
    assert sorted(os.listdir(tmp_path / ".work")) == ["CACHEDIR.TAG", "lock", "stage.npz"]


def test_the_lock_of_a_killed_process_is_taken_over(tmp_path, holder):
    holder.send_signal(signal.SIGKILL if hasattr(signal, "SIGKILL") else signal.SIGTERM)
    holder.wait()
    assert (tmp_path / ".work" / "lock").exists()
    work = WorkFolder(tmp_path)
    assert json.loads((tmp_path / ".work" / "lock").read_text())["process"] == os.getpid()
    assert (work.path / "stage.npz").exists()
    work.clear()
    work.close()
    assert not tmp_path.exists()


def test_a_run_on_another_computer_is_not_taken_over(tmp_path):
    (tmp_path / ".work").mkdir()
    lock = tmp_path / ".work" / "lock"
    lock.write_text(json.dumps({"process": 1, "host": "elsewhere", "command": "marey capture walk"}))
    with pytest.raises(FileProblem, match=rf"on elsewhere, command marey capture walk\).*remove {lock}"):
        WorkFolder(tmp_path)
    lock.unlink()
    WorkFolder(tmp_path).close()


def test_one_thread_can_open_the_folder_several_times_and_another_thread_cannot(tmp_path):
    outer, inner = WorkFolder(tmp_path), WorkFolder(tmp_path / "." / "")
    (outer.path / "stage.npz").write_text("outer")
    inner.clear()
    inner.close()
    inner.close()
    assert (outer.path / "stage.npz").exists()
    assert (outer.path / "lock").exists()
    problems = []

    def other() -> None:
        try:
            WorkFolder(tmp_path)
        except FileProblem as problem:
            problems.append(str(problem))

    thread = threading.Thread(target=other)
    thread.start()
    thread.join()
    assert "in use" in problems[0]
    outer.close()
    assert sorted(os.listdir(tmp_path / ".work")) == ["CACHEDIR.TAG", "stage.npz"]


def test_a_folder_of_the_user_is_not_touched(tmp_path):
    (tmp_path / ".work").mkdir()
    (tmp_path / ".work" / "mine.txt").write_text("mine")
    with pytest.raises(FileProblem, match=r"\.work: holds files that are not checkpoints.*Rename or remove it"):
        WorkFolder(tmp_path)
    assert os.listdir(tmp_path / ".work") == ["mine.txt"]


def test_an_empty_folder_and_a_half_written_mark_are_ours(tmp_path):
    (tmp_path / ".work").mkdir()
    (tmp_path / ".work" / "CACHEDIR.TAG").write_text("Sig")
    work = WorkFolder(tmp_path)
    (work.path / "stage.npz").write_text("x")
    WorkFolder(tmp_path).close()
    work.clear()
    work.close()
    assert not tmp_path.exists()


def test_a_folder_that_cannot_be_created_is_an_error(tmp_path):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(FileProblem, match="cannot be created"):
        WorkFolder(tmp_path / "out")


def test_a_read_only_folder_is_an_error(mounted):
    with pytest.raises(FileProblem, match=r"cannot be created \(Read-only file system"):
        WorkFolder(mounted("ro") / "out")
