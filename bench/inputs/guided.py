"""Damaged files that are searched by the coverage of the readers.

Unlike in `inputs/readers`, which damages files blindly, each file is a change of one that reached new lines of the
reader. atheris, a development tool that is not part of the test environment, makes the changes; `pip install atheris`
provides it. Each reader runs in a process of its own, from its valid sample, for `--seconds`. It must return a result,
or raise the program's own error, which names the file. Files that end otherwise are kept in the output folder.
"""

import argparse
import importlib.util
import json
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

from tests import file_samples, film_samples

from bench.declaration import Bench
from bench.recording import Column, Run

BENCH = Bench(
    measures="What readers do with files that are damaged under guidance of their coverage.",
    sources=("src/marey/io", "bench/common/guided_reader.py", "tests/file_samples.py", "tests/film_samples.py"),
    minutes=150,
    data=False,
)
_MOST_ENDS = 5
"""Number of ends of the process after which a reader is given up."""
_GRACE = 600
"""Time beyond `--seconds` after which a process is ended: for its start on a busy machine, and one slow file [s]."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("readers", nargs="*", help="names of readers; all without any")
    parser.add_argument("--seconds", type=int, default=90, help="time of each reader")
    parser.add_argument("--seed", type=int, default=1)


def run(run: Run) -> None:
    """Search damaged files for all readers."""
    if importlib.util.find_spec("atheris") is None:
        raise SystemExit("This benchmark needs atheris: pip install atheris.")
    given = run.arguments
    table = run.table(
        f"Files that coverage guided, {given.seconds} s for each reader", "reader", Column("files", "", 0),
        Column("reported", "", 0), Column("failures", "", 0), Column("what failed"),
    )  # fmt: skip
    totals = Counter[str]()
    for group, write in (file_samples.GROUPS | film_samples.GROUPS).items():
        folder = run.out / group
        shutil.rmtree(folder, ignore_errors=True)
        (folder / "names").mkdir(parents=True)
        for name in write(folder / "names"):
            if not given.readers or name in given.readers:
                found = _searched(folder, group, name, given.seconds, given.seed)
                failed = {what: n for what, n in found.items() if what not in ("read", "reported")}
                row = (sum(found.values()), found["reported"], sum(failed.values()))
                totals.update(files=row[0], reported=row[1], failures=row[2])
                table.row(name, *row, "; ".join(f"{what} ({n})" for what, n in failed.items()) or None)
    table.row("all", totals["files"], totals["reported"], totals["failures"], None)


def _searched(folder: Path, group: str, name: str, seconds: int, seed: int) -> Counter[str]:
    """Return how often a reader has read, reported, or failed; after an end of its process, it goes on in a new one."""
    found, left, ends = Counter[str](), float(seconds), 0
    while left > 1 and ends < _MOST_ENDS:
        counts = folder / "counts.json"
        counts.unlink(missing_ok=True)
        command = [sys.executable, "-m", "bench.common.guided_reader", group, name, str(folder)]
        process = subprocess.Popen(
            [*command, str(int(left)), str(seed + ends)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )  # fmt: skip
        try:
            ended = "" if process.wait(left + _GRACE) == 0 else "end of the process"
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            ended = "no answer"
        state = json.loads(counts.read_text()) if counts.exists() else {"found": {}, "seconds": 0.0}
        found.update(state["found"])
        if not ended:
            break
        found[ended] += 1
        ends += 1
        left -= state["seconds"]
    return found
