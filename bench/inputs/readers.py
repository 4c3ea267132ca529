"""Damaged files of every format, given to the reader of the format.

Each reader receives a small valid file that is damaged in one place: a number, some bytes, a part that is missing or
is there twice, a value of a JSON tree or of the document of a GLB, an array of an NPZ. It runs in a process of its own,
with bounded memory; by how much the memory of the process grew at most is stated. A reader must return a result, or
raise the program's own error, which names the file. Everything else counts as a failure: another error, an end of the
process, more than `--seconds` without an answer.
"""

import argparse
import multiprocessing
import os
import resource
import shutil
import signal
import warnings
from collections import Counter
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from tests import file_samples, film_samples
from tests.damaged_files import damaged
from tests.file_samples import FileSample

from bench.declaration import Bench
from bench.recording import Column, Run
from marey.errors import MareyError

BENCH = Bench(
    measures="What readers do with damaged files: a result, or one line that names the file.",
    sources=("src/marey/io", "tests/damaged_files.py", "tests/file_samples.py", "tests/film_samples.py"),
    minutes=30,
    data=False,
)
GROUPS = file_samples.GROUPS | film_samples.GROUPS
"""The samples of all readers, by the kind of file."""
MEMORY_KB = "memory"
"""Key of the memory among the counts."""
MEMORY = 6 * 2**30
"""Memory that a reader may use [bytes]."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("readers", nargs="*", help="names of readers; all without any")
    parser.add_argument("--count", type=int, default=400, help="damaged files of each reader")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=int, default=20, help="longest time of one file")


def run(run: Run) -> None:
    """Read damaged files with all readers."""
    given = run.arguments
    table = run.table(
        f"Damaged files, {given.count} for each reader", "reader", Column("read"), Column("reported"),
        Column("failures"), Column("memory", "MB", 0), Column("what failed"),
    )  # fmt: skip
    totals = np.zeros(3, int)
    for group, write in GROUPS.items():
        folder = run.out / group
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for name, sample in write(folder).items():
            if not given.readers or name in given.readers:
                found = outcomes(sample, given.count, given.seed, given.seconds)
                memory = found.pop(MEMORY_KB) / 1024
                failed = {what: n for what, n in found.items() if what not in ("read", "reported")}
                row = (found["read"], found["reported"], sum(failed.values()))
                totals += row
                table.row(name, *row, memory, "; ".join(f"{what} ({n})" for what, n in failed.items()) or None)
    table.row("all", *map(int, totals), None, None)


def outcomes(sample: FileSample, count: int, seed: int, seconds: int) -> Counter[str]:
    """Return how often a reader has read, reported, or failed, and by how much its memory grew [KB].

    After an end of the process, it goes on in a new one.
    """
    whole, found, begin = sample.path.read_bytes(), Counter[str](), 0
    while begin < count:
        receiving, sending = multiprocessing.Pipe(duplex=False)
        process = multiprocessing.get_context("fork").Process(
            target=_read_all, args=(sending, sample, whole, range(begin, count), seed, seconds)
        )
        process.start()
        sending.close()
        begin = _received(receiving, found, begin, seconds, process.kill)
        process.join()
    sample.path.write_bytes(whole)
    return found


def _received(
    receiving: Connection, found: Counter[str], begin: int, seconds: int, kill: Callable[[], None]
) -> int:  # fmt: skip
    """Count what a process reports; return the number of the next file."""
    while True:
        if not receiving.poll(2 * seconds + 10):
            kill()
            found["no answer"] += 1
            return begin + 1
        try:
            what = receiving.recv()
        except EOFError:
            found["end of the process"] += 1
            return begin + 1
        if isinstance(what, int):
            found[MEMORY_KB] = max(found[MEMORY_KB], what)
            return begin
        found[what] += 1
        begin += 1


def _read_all(
    sending: Connection, sample: FileSample, whole: bytes, numbers: range, seed: int, seconds: int
) -> None:  # fmt: skip
    """Read the damaged files of some numbers, in a process of its own."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGALRM, _too_long)
    for number in numbers:
        sample.path.write_bytes(damaged(sample.path, whole, np.random.default_rng([seed, number])))
        signal.alarm(seconds)
        what = outcome(sample)
        signal.alarm(0)
        sending.send(what)
    sending.send(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    sending.close()


def outcome(sample: FileSample) -> str:
    """Read a file; return `read`, `reported`, or what failed."""
    try:
        sample.read(sample.path)
    except MareyError as problem:
        return "reported" if str(_top(sample.path)) in str(problem) else "a report without the file"
    except BaseException as error:
        return type(error).__name__
    return "read"


def _top(path: Path) -> Path:
    """Return the folder that the path in a report begins with, whichever file beside the damaged one it names."""
    return path.parent if path.parent.name in GROUPS else _top(path.parent)


def _too_long(*given: object) -> None:
    raise TimeoutError
