"""Kernels of a list are compiled by other processes, and found in the cache."""

import os
import subprocess
import sys
import time
from contextlib import suppress

import numba
import numpy as np
import pytest
from tests.processes import started

import marey
from marey.compiled import ahead
from marey.compiled.ahead import compile_missing, compiled_ahead
from marey.compiled.kernel_lists import ListedKernel, listed_kernels
from marey.compiled.kernels import kernel

SMALL = "marey.compiled.kernel_copies.copy_row(float64[::1], float64[::1])"
"""A kernel that takes a moment to compile."""

AHEAD = """
import json, sys
from marey.compiled import ahead
from marey.compiled.ahead import compiled_ahead
from marey.compiled.kernel_lists import ListedKernel, listed_kernels

def listed_kernels(name):
    return [ListedKernel.parsed(entry) for entry in sys.argv[1:]]

ahead.listed_kernels = listed_kernels
with compiled_ahead("capture", processes=1):
    pass
print(ahead.compile_missing(listed_kernels("")), ahead.compile_missing(listed_kernels("")), flush=True)
print([kernel.is_missing for kernel in listed_kernels("")])
"""

CALLED = """
import sys
from marey.compiled.kernel_dispatch import KernelDispatcher
from marey.compiled.kernel_lists import ListedKernel, listed_kernels

compiled = KernelDispatcher._compile_once

def recorded(self, kinds, *, is_entry=False):
    if is_entry:
        print(ListedKernel(f"{self.py_func.__module__}.{self.py_func.__qualname__}", kinds), flush=True)
    return compiled(self, kinds, is_entry=is_entry)

KernelDispatcher._compile_once = recorded
from marey.cli import main
sys.exit(main.run(sys.argv[1:]))
"""


@kernel
def doubled(value):
    return 2 * value


@kernel
def third(values):
    return values / 3


@kernel
def sum_of_thirds(values):
    return third(values).sum()


def entry(function, *kinds) -> ListedKernel:
    return ListedKernel(f"{__name__}.{function.py_func.__name__}", kinds)


def test_a_missing_kernel_is_compiled_once(tmp_path):
    process = started(AHEAD, SMALL, SMALL, NUMBA_CACHE_DIR=str(tmp_path))
    assert process.communicate(timeout=60)[0] == "1 0\n[False, False]\n"
    assert len(list((tmp_path / "marey").glob("*copy_row*"))) == 1


def test_code_for_other_kernels_alone_is_not_enough():
    """Python cannot call what was only compiled as a part of another kernel."""
    assert sum_of_thirds(np.arange(4.0)) == 2.0
    numbers = numba.float64[::1]
    assert not entry(sum_of_thirds, numbers).is_missing
    assert entry(third, numbers).is_missing


@pytest.mark.slow
def test_another_process_compiles_while_this_one_goes_on(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    code = "from marey.compiled.ahead import compiled_ahead; import sys; from pathlib import Path; import time\n"
    code += "with compiled_ahead('capture', processes=2):\n"
    code += "    while len(list(Path(sys.argv[1]).glob('*.nbc'))) < 2: time.sleep(0.05)\n"
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "marey")], timeout=120, check=False)
    assert done.returncode == 0
    count = len(list((tmp_path / "marey").glob("*.nbc")))
    time.sleep(1.0)
    assert count == len(list((tmp_path / "marey").glob("*.nbc"))), "a process still compiles"


def test_nothing_is_started_with_one_core_or_where_nothing_is_missing(monkeypatch):
    monkeypatch.setattr(subprocess, "Popen", lambda *words, **options: pytest.fail("a process was started"))
    with compiled_ahead("capture", processes=1):
        pass
    monkeypatch.setattr(ahead, "listed_kernels", lambda name: [])
    with compiled_ahead("capture", processes=8):
        pass


def test_processes_are_as_many_as_are_useful_and_end_with_the_work(monkeypatch, tmp_path):
    commands, states = [], []

    class Process:
        def __init__(self, command, **options):
            commands.append(command)

        def terminate(self):
            states.append("terminated")

        def wait(self):
            states.append("waited for")

    monkeypatch.setattr(subprocess, "Popen", Process)
    monkeypatch.setattr(ListedKernel, "is_missing", True)
    for processes, count in ((2, 1), (4, 3), (64, ahead.MOST_PROCESSES)):
        commands.clear(), states.clear()
        with suppress(ZeroDivisionError), compiled_ahead("capture", processes=processes):
            assert not states
            raise ZeroDivisionError
        assert len(commands) == count
        assert states == ["terminated"] * count + ["waited for"] * count


def test_a_kernel_that_another_process_compiles_is_left_to_it(monkeypatch):
    own = entry(doubled, numba.types.complex128)
    monkeypatch.setattr(type(doubled), "is_free", lambda self, kinds: False)
    monkeypatch.setattr(ListedKernel, "is_missing", True)
    assert compile_missing([own]) == 0
    assert own.arguments not in doubled.overloads


def test_the_process_keeps_kernels_in_the_folder_of_the_one_that_started_it(tmp_path):
    """A process that would keep them elsewhere has nothing to do."""
    command = [sys.executable, "-P", "-m", "marey.compiled.ahead", "capture", str(tmp_path / "other")]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "here")}
    subprocess.run(command, env=environment, timeout=60, check=True)
    assert not list(tmp_path.rglob("*.nbc"))


@pytest.mark.slow
def test_the_list_of_a_capture_contains_what_a_capture_calls(tmp_path):
    trial = marey.example_folder()
    words = ["capture", str(trial), "--frames", "20:32", "--workers", "1", "--out", str(tmp_path / "out"), "-q"]
    process = started(CALLED, *words)
    called = {line for line in process.communicate()[0].splitlines() if line.startswith("marey.")}
    assert process.returncode == 0
    assert len(called) > 10
    unlisted = called - {str(kernel) for kernel in listed_kernels("capture")}
    assert not unlisted, "write the lists again: python -m bench run speed/compilation capture --write-lists"
