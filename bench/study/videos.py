"""Steps on videos in a study, beside the same commands alone.

A study of the take `reach` with four steps: surface, shape on this surface, capture with the body of the shape, and
capture with the generic body; then the commands `marey surface`, `marey shape` and `marey capture` with the same
settings. Compared are all files but `run.json` and the pages, byte by byte.
"""

import os
import shutil
import subprocess
import sys
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
TAKE = "reach"
"""The take of data/people."""
TOML = """
pattern = "*"

[[steps]]
command = "surface"
frames = [40, 42]

[[steps]]
command = "shape"
surface = "{results}/surface"
frames = [40, 42]
overlay = false

[[steps]]
command = "capture"
name = "own"
body = "{results}/shape/body.npz"
frames = [40, 46]
overlay = false

[[steps]]
command = "capture"
frames = [40, 46]
overlay = false
"""
ALONE = {
    "surface": ["surface", "--frames", "40:42", "--out", "both"],
    "shape": ["shape", "--frames", "40:42", "--no-overlay", "--out", "both"],
    "own": ["capture", "--frames", "40:46", "--no-overlay", "--body", "both/body.npz", "--out", "own"],
    "capture": ["capture", "--frames", "40:46", "--no-overlay", "--out", "capture"],
}
"""The commands alone, by the step of the study; `marey shape` uses the surface in the folder of its results."""
_OF_A_RUN = (".html", "run.json")
"""Endings of files that state times or link other files."""


def run(run: Run) -> None:
    """Run the study and the commands, and compare."""
    folder, alone = run.out / "videos", run.out / "alone"
    for each in (folder, alone):
        shutil.rmtree(each, ignore_errors=True)
    shutil.copytree(run.shared / "data" / "people" / TAKE, folder / TAKE)
    (folder / "study.toml").write_text(TOML)
    table = run.table(
        "Steps of a study beside commands alone", "step", Column("state"), Column("verdict"), Column("time", "s", 0),
        Column("largest memory of the worker", "MB", 0), Column("files compared"), Column("files that differ"),
        note="Memory: the largest of the worker up to the end of the step, in their order.",
    )  # fmt: skip
    out = folder / "results"
    _marey(["study", str(folder), "--workers", "1"], folder)
    alone.mkdir()
    for words in ALONE.values():
        _marey([words[0], str(folder / TAKE), *words[1:]], alone)
    for row in walking_study.rows_of(out):
        step = row["step"]
        pairs = list(_pairs(out / TAKE / step, alone / ALONE[step][-1]))
        differing = [name for name, found, wanted in pairs if found != wanted]
        run.report(", ".join(differing))
        table.row(
            step, row["state"], row["verdict"], float(row["seconds"]), float(row["memory_mb"]), len(pairs),
            len(differing),
        )  # fmt: skip


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
