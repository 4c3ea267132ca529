"""Steps on videos in a study, beside the same commands alone.

A study of the take `arm3`, whose cameras are near each other: surface, and shape on this surface; a study of `reach`:
capture. Then the commands `marey surface`, `marey shape` and `marey capture` with the same
settings. Compared are all files but `run.json` and the pages, byte by byte.
"""

import os
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path

from bench.common import walking_study
from bench.declaration import Bench
from bench.recording import Column, Run

BENCH = Bench(
    measures="Surface, shape and capture as steps of a study, against the same commands alone.",
    sources=("src/marey/pipelines/study", "src/marey/io/study"),
    minutes=6,
)
STUDIES = {
    "arm3": """
        [[steps]]
        command = "surface"
        frames = [0, 2]
        [[steps]]
        command = "shape"
        surface = "{results}/surface"
        preset = "right_arm"
        frames = [0, 2]
        overlay = false
        """,
    "reach": """
        [[steps]]
        command = "capture"
        frames = [40, 46]
        overlay = false
        """,
}
"""The study of each take of data/people."""
ALONE = {
    "surface": "surface --frames 0:2 --out both",
    "shape": "shape --frames 0:2 --preset right_arm --no-overlay --out both",
    "capture": "capture --frames 40:46 --no-overlay --out capture",
}
"""The command alone of each step; `marey shape` uses the surface in the folder of its results."""
_OF_A_RUN = (".html", "run.json")
"""Endings of files that state times or link other files."""


def run(run: Run) -> None:
    """Run the studies and the commands, and compare."""
    table = run.table(
        "Steps of a study beside commands alone", ("take", "step"), Column("state"), Column("verdict"),
        Column("time", "s", 0), Column("largest memory of the worker", "MB", 0), Column("files compared"),
        Column("files that differ"), note="Memory: the largest of the worker up to the end of the step.",
    )  # fmt: skip
    for take, steps in STUDIES.items():
        folder = run.out / f"study_{take}"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(run.shared / "data" / "people" / take, folder / take)
        (folder / "study.toml").write_text('pattern = "*"\n' + textwrap.dedent(steps))
        _marey(["study", str(folder), "--workers", "1"], folder)
        for row in walking_study.rows_of(folder / "results"):
            _marey(_words(row["step"], folder / take), folder)
            pairs = list(_pairs(folder / "results" / take / row["step"], folder / ALONE[row["step"]].split()[-1]))
            differing = [name for name, found, wanted in pairs if found != wanted]
            run.report(", ".join(differing))
            table.row(
                (take, row["step"]), row["state"], row["verdict"], float(row["seconds"]), float(row["memory_mb"]),
                len(pairs), len(differing),
            )  # fmt: skip


def _words(step: str, trial: Path) -> list[str]:
    command, *options = ALONE[step].split()
    return [command, str(trial), *options]


def _marey(words: Sequence[str], folder: Path) -> None:
    one = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")}
    command = [sys.executable, "-m", "marey", *words, "-q"]
    done = subprocess.run(command, cwd=folder, env=os.environ | one, capture_output=True, text=True)
    if done.returncode not in (0, 3):
        raise RuntimeError(f"{' '.join(words)} ended with {done.returncode}: {done.stderr}")


def _pairs(found: Path, alone: Path) -> Iterator[tuple[str, bytes, bytes | None]]:
    """Name and content of each file of a step, with that of the command alone; None where it wrote no such file."""
    for path in sorted(found.rglob("*")):
        name = path.relative_to(found).as_posix()
        if path.is_file() and not name.endswith(_OF_A_RUN):
            other = alone / name
            yield name, path.read_bytes(), other.read_bytes() if other.is_file() else None
