"""Of several processes that need a kernel at the same time, one compiles it."""

import json
import signal
import subprocess
from collections.abc import Iterator

import pytest
from tests.processes import started

from marey.compiled.kernel_lock import EntryLock

HOLDER = """
import sys
from pathlib import Path
from marey.compiled.kernel_lock import EntryLock
lock = EntryLock(Path(sys.argv[1]), 7)
print(lock.acquire(), flush=True)
sys.stdin.readline()
lock.release()
print("released", flush=True)
sys.stdin.readline()
"""

COMPILING = """
import json, sys
from marey.compiled.kernels import kernel

@kernel
def summed(values):
    total = 0.0
    for value in values:
        total += value
    return total

print("ready", flush=True)
sys.stdin.readline()
import numpy as np
result = summed(np.arange(4.0))
print(json.dumps([result, sum(summed.stats.cache_misses.values()), sum(summed.stats.cache_hits.values())]))
"""


@pytest.fixture
def holder(tmp_path) -> Iterator[subprocess.Popen]:
    """Another process that holds the lock 7."""
    process = started(HOLDER, str(tmp_path))
    assert process.stdout.readline() == "True\n"
    yield process
    process.kill()
    process.communicate()


def test_a_lock_is_held_by_one_process(tmp_path, holder):
    lock = EntryLock(tmp_path, 7)
    assert not lock.acquire(wait_s=0.0)
    holder.stdin.write("\n")
    holder.stdin.flush()
    assert holder.stdout.readline() == "released\n"
    assert lock.acquire(wait_s=0.0)
    lock.release()


def test_locks_of_different_entries_are_independent(tmp_path, holder):
    lock = EntryLock(tmp_path, 8)
    assert lock.acquire(wait_s=0.0)
    lock.release()


def test_the_lock_of_a_process_that_was_killed_is_free(tmp_path, holder):
    holder.send_signal(signal.SIGKILL if hasattr(signal, "SIGKILL") else signal.SIGTERM)
    holder.wait()
    lock = EntryLock(tmp_path, 7)
    assert lock.acquire(wait_s=10.0)
    lock.release()


def test_a_folder_that_cannot_be_made_has_no_lock(tmp_path):
    (tmp_path / "file").touch()
    lock = EntryLock(tmp_path / "file" / "folder", 7)
    assert not lock.acquire(wait_s=10.0)
    lock.release()


@pytest.mark.slow
def test_of_two_processes_one_compiles_a_kernel(tmp_path):
    (tmp_path / "shapes.py").write_text(COMPILING, encoding="utf-8")
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import shapes"
    processes = [started(code, MAREY_CACHE_DIR=str(tmp_path / "cache"), NUMBA_CACHE_DIR="") for _ in range(2)]
    for process in processes:
        assert process.stdout.readline() == "ready\n"
    for process in processes:
        process.stdin.write("\n")
        process.stdin.flush()
    found = sorted(json.loads(process.communicate()[0]) for process in processes)
    assert found == [[6.0, 0, 1], [6.0, 1, 0]]
