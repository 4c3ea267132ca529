"""Compilation of the kernels of each command: its time, and whether a kernel is compiled twice.

Each command runs three times in processes of its own, on a short part of a recording: with an empty cache of compiled
kernels and one core, so that one process compiles everything; with an empty cache and all cores, so that several
processes compile ahead what is in the list of the command; and with the cache that this run has left. A kernel that is
loaded from the cache is not compiled. A kernel counts as compiled twice if the same function of marey is compiled for
the same types of arguments again.
"""

import argparse
import json
import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from bench.declaration import Bench
from bench.recording import Column, Run
from marey.compiled.kernel_library import is_machine_code
from marey.compiled.kernel_lists import ListedKernel, list_text

BENCH = Bench(
    measures="Time in which each command compiles its kernels at its first run, and kernels that are compiled twice.",
    sources=(
        "src/marey/compiled/kernels.py", "src/marey/compiled/kernel_cache.py", "src/marey/compiled/kernel_dispatch.py",
        "src/marey/compiled/kernel_library.py", "src/marey/compiled/ahead.py", "bench/common/compiled_kernels.py",
    ),
    minutes=15,
)  # fmt: skip
_COMMANDS = {
    "capture": "capture examples/reach -q",
    "capture, no empty room": "capture {data}/people/market --keypoints {data}/people/market/keypoints --frames 30:40 "
    "--no-overlay -q",
    "surface": "surface {data}/people/arm3 --frames 30:33 --spacing 8 -q",
    "shape": "shape {data}/people/arm3 --frames 30:33 --no-overlay -q",
    "markers": "markers {data}/markers/functional/walk.c3d --static {data}/markers/functional/static.c3d -q",
    "nonrigid": "nonrigid {data}/nonrigid/yoga.npz -q",
    "calibrate": "calibrate {data}/calibration/boards3 -q",
}
"""The commands, on short parts of recordings."""
_LISTS = Path("src/marey/compiled/lists")
"""Folder of the lists of kernels; see `marey.compiled.kernel_lists`. A command of this name has one."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("commands", nargs="*", help=f"only these: {', '.join(_COMMANDS)}")
    parser.add_argument("--write-lists", action="store_true", help=f"replace the lists of these commands in {_LISTS}")


def run(run: Run) -> None:
    """Run the commands."""
    table = run.table(
        "Compilation", "command", Column("kernels", "", 0), Column("compiled twice", "", 0),
        Column("compilation with one core, processor time", "s", 1), Column("first run", "s", 1),
        Column("second run", "s", 1), Column("wait for compilation", "s", 1),
        Column("compiled in the second run", "", 0),
    )  # fmt: skip
    for name, typed in _COMMANDS.items():
        if run.arguments.commands and name not in run.arguments.commands:
            continue
        folder = run.out / "compilation" / name.replace(",", "").replace(" ", "_")
        shutil.rmtree(folder, ignore_errors=True)
        words = typed.format(data=run.shared / "data").split()
        one_core = ["--workers", "1"] if (_LISTS / f"{name}.toml").exists() else []
        alone = _observed(folder / "one_core", [*words, *one_core], "first")
        if run.arguments.write_lists and one_core:
            (_LISTS / f"{name}.toml").write_text(list_text(_called(folder / "one_core" / "kernels" / "marey")))
        first, second = (_observed(folder / "all_cores", words, out) for out in ("first", "second"))
        twice = {kernel: count for kernel, count in alone["kernels"].items() if count > 1}
        for kernel, count in twice.items():
            run.report(f"  {name}: compiled {count} times: {kernel}")
        table.row(
            name, len(alone["kernels"]), len(twice), alone["processor_s"], first["whole_s"], second["whole_s"],
            first["whole_s"] - second["whole_s"], len(second["kernels"]),
        )  # fmt: skip


def _called(folder: Path) -> list[ListedKernel]:
    """List the kernels with machine code among the entries of a cache, in the order in which they were compiled."""
    found = []
    for path in sorted(folder.glob("*.nbc"), key=lambda path: path.stat().st_mtime_ns):
        _, signature, (_, _, (library, described, *_)) = pickle.loads(path.read_bytes())
        if is_machine_code(library):
            found.append(ListedKernel(f"{described.modname}.{described.qualname}", tuple(signature)))
    return found


def _observed(folder: Path, words: list[str], out: str) -> dict[str, Any]:
    """Run the program in a process of its own, whose compiled kernels and results are kept in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    path, words = folder / f"{out}.json", [*words, "--out", str(folder / out)]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "kernels")}
    command = [sys.executable, "-m", "bench.common.compiled_kernels", str(path), *words]
    done = subprocess.run(command, env=environment, check=False, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    if not path.exists() or done.returncode not in (0, 3):
        raise SystemExit(f"marey {' '.join(words)} has ended with code {done.returncode}: {done.stderr.decode()}")
    found: dict[str, Any] = json.loads(path.read_text())
    return found
