"""The cost of the whole `marey knee segment`, stage by stage.

Each volume is segmented with its template by the command itself, in a process of its own. The seconds of each stage
and of its steps are those of run.json. After a change of the code Numba compiles at first: run it twice.
"""

import argparse
import json
import os
import subprocess
import sys
import time

from bench.declaration import Bench
from bench.recording import Column, Run, Table

BENCH = Bench(
    measures="Time and memory of `marey knee segment`, stage by stage.",
    sources=("src/marey/knee", "src/marey/pipelines/knee"),
    minutes=3,
)
BONE_S, KNEE_S, MEMORY_GB = 180.0, 600.0, 4.0
CASES = {
    "dess": (("dess",), "atlas"),
    "phantom_a": (("phantom_a",), "atlas"),
    "phantom_spl": (("phantom_spl",), "template_a"),
    "phantom_spl_t1": (("phantom_spl_t1",), "template_a"),
    "pair": (("phantom_spl", "phantom_spl_t1"), "template_a"),
}
OF_BONES = ("Reading", "Bones", "Surfaces")


def measure(run: Run, table: Table, name: str) -> None:
    """Run the command, and append its stages."""
    volumes, template = CASES[name]
    knee, out = run.shared / "data" / "knee", run.out / "speed_knee" / name
    words = ["knee", "segment", *(str(knee / each / "image.nii.gz") for each in volumes)]
    words += ["--template", str(knee / template), "--out", str(out), "--quiet"]
    began = time.perf_counter()
    command = subprocess.Popen([sys.executable, "-c", "from marey.cli.main import main; main()", *words])
    _, status, used = os.wait4(command.pid, 0)
    whole = time.perf_counter() - began
    if os.waitstatus_to_exitcode(status):
        raise SystemExit(f"{name}: the command failed.")
    record = json.loads((out / "run.json").read_text(encoding="utf-8"))
    bones = len(list(out.glob("*_thickness.npz")))
    stages = record["timings_s"]
    for stage, seconds in stages.items():
        table.row((name, stage, ""), seconds, None)
        for step, part in record["steps_s"].get(stage, {}).items():
            table.row((name, stage, step), part, None)
    table.row((name, "starting, writing", ""), whole - sum(stages.values()), None)
    table.row((name, "per bone", ""), sum(stages[stage] for stage in OF_BONES) / bones, BONE_S)
    table.row((name, "the knee", ""), whole, KNEE_S)
    table.row((name, "the knee, processor time", ""), used.ru_utime + used.ru_stime, None)
    table.note += f" Most memory of `{name}`: {used.ru_maxrss / 1e6:.2f} GB (limit {MEMORY_GB:g})."


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("names", nargs="*", help=f"of {', '.join(CASES)}; phantom_a without any")


def run(run: Run) -> None:
    """Segment, and time."""
    columns = (Column("time", "s", 1), Column("limit", "s", 0))
    table = run.table("`marey knee segment`", ("volume", "stage", "step"), *columns)
    for name in run.arguments.names or ("phantom_a",):
        measure(run, table, name)
