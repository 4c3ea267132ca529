"""Compilation of the kernels of each command: its time, and whether a kernel is compiled twice.

Each command runs twice in processes of its own, on a short part of a recording: with an empty cache of compiled
kernels, and with the cache that the first run has left. A kernel that is loaded from the cache is not compiled. A
kernel counts as compiled twice if the same function of marey is compiled for the same types of arguments again.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from bench.declaration import Bench
from bench.recording import Column, Run

BENCH = Bench(
    measures="Time in which each command compiles its kernels at its first run, and kernels that are compiled twice.",
    sources=(
        "src/marey/compiled/kernels.py", "src/marey/compiled/kernel_cache.py", "src/marey/compiled/kernel_dispatch.py",
        "src/marey/compiled/kernel_library.py", "bench/common/compiled_kernels.py",
    ),
    minutes=15,
)  # fmt: skip
_COMMANDS = {
    "capture": "demo -q",
    "capture, no empty room": "capture {data}/people/market --keypoints {data}/people/market/keypoints --frames 30:40 "
    "--no-overlay -q",
    "surface": "surface {data}/people/arm3 --frames 30:33 --spacing 8 -q",
    "shape": "shape {data}/people/arm3 --frames 30:33 --no-overlay -q",
    "markers": "markers {data}/markers/functional/walk.c3d --static {data}/markers/functional/static.c3d -q",
    "nonrigid": "nonrigid {data}/nonrigid/yoga.npz -q",
    "calibrate": "calibrate {data}/calibration/boards3 -q",
}
"""The commands, on short parts of recordings."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("commands", nargs="*", help=f"only these: {', '.join(_COMMANDS)}")


def run(run: Run) -> None:
    """Run the commands."""
    table = run.table(
        "Compilation", "command", Column("kernels", "", 0), Column("compiled twice", "", 0),
        Column("compilation, processor time", "s", 1), Column("first run", "s", 1), Column("second run", "s", 1),
        Column("compiled in the second run", "", 0),
    )  # fmt: skip
    for name, typed in _COMMANDS.items():
        if run.arguments.commands and name not in run.arguments.commands:
            continue
        folder = run.out / "compilation" / name.replace(",", "").replace(" ", "_")
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        words = typed.format(data=run.shared / "data").split()
        first, second = (_observed(folder, [*words, "--out", str(folder / f"out{k}")]) for k in (1, 2))
        twice = {kernel: count for kernel, count in first["kernels"].items() if count > 1}
        for kernel, count in twice.items():
            run.report(f"  {name}: compiled {count} times: {kernel}")
        table.row(
            name, len(first["kernels"]), len(twice), first["processor_s"], first["whole_s"], second["whole_s"],
            len(second["kernels"]),
        )  # fmt: skip


def _observed(folder: Path, words: list[str]) -> dict[str, Any]:
    """Run the program in a process of its own, whose compiled kernels are kept in a folder."""
    path = folder / "compiled.json"
    path.unlink(missing_ok=True)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "kernels")}
    command = [sys.executable, "-m", "bench.common.compiled_kernels", str(path), *words]
    done = subprocess.run(command, env=environment, check=False, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    if not path.exists() or done.returncode not in (0, 3):
        raise SystemExit(f"marey {' '.join(words)} has ended with code {done.returncode}: {done.stderr.decode()}")
    found: dict[str, Any] = json.loads(path.read_text())
    return found
