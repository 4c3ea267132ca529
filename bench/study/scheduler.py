"""What a study costs beside its steps: the scheduler, and the tables and page at the end, for many trivial trials.

`steps`: steps that return at once, on two workers. The time of the processor is that of the process of client and
scheduler; bytes are those that the kernel counted on the sockets of the scheduler, both directions. `idle`: the same
bytes while nothing runs. `tables`: steps that only write the record and the curves of a real walk, all frames of
`functional/walk.c3d`, with values that differ between trials; measured is what `marey study` does after the last step,
and the memory of its process. Each row is a process of its own.
"""

import argparse
import ctypes
import json
import os
import resource
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.common import walking_study
from bench.common.parts import add_parts, run_parts
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.io.study.records import read_step_record, write_step_record
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.study import cluster, schedule, study
from marey.pipelines.study.schedule import TrialPlan
from marey.pipelines.study.steps import StepOutcome, StepTask

BENCH = Bench(
    measures="Time, bytes and memory that a study of many trials needs beside its steps.",
    sources=("src/marey/pipelines/study", "src/marey/io/study", "src/marey/view/study"),
    minutes=5,
)
WORKERS = 2
"""Number of workers."""
IDLE_S = 10.0
"""Time for which an idle cluster is watched [s]."""
_TEMPLATE = "BENCH_STUDY_TEMPLATE"
"""Variable with the folder of the real trial: what a step of `tables` copies."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_parts(parser, PARTS)
    parser.add_argument("--trials", type=int, nargs="+", default=[200, 1000])


def run(run: Run) -> None:
    """Measure the parts."""
    run_parts(run, PARTS)


def _child(function: str, *given: object, **variables: str) -> dict[str, Any]:
    """Call a function of this module in a process of its own; what it returns."""
    code = f"import json; from bench.study import scheduler; print(json.dumps(scheduler.{function}(*{given!r})))"
    done = subprocess.run(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, check=True, env=os.environ | variables
    )  # fmt: skip
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


# Steps


def empty_step(task: StepTask) -> StepOutcome:
    """Return at once."""
    return StepOutcome(trial=task.trial, step=task.step, state="done")


def _steps(run: Run) -> None:
    table = run.table(
        "Steps that return at once", "trials", Column("time", "s", 1), Column("per trial", "ms", 2),
        Column("of the processor per trial", "ms", 2), Column("between client and scheduler per trial", "bytes", 0),
        Column("between scheduler and workers per trial", "bytes", 0), Column("memory after the trials", "MB", 0),
        Column("growth per trial", "kB", 2),
    )  # fmt: skip
    for trials in run.arguments.trials:
        table.row(str(trials), *_child("measure_steps", trials).values())


def measure_steps(trials: int) -> dict[str, float]:
    """Run empty steps; figures per trial."""
    names = [f"S{k // 100:03d}/walk_{k % 100}" for k in range(trials)]
    plans = [TrialPlan(trial=name, tasks=(_task(name),)) for name in names]
    schedule.run_step = empty_step
    with _client() as client:
        schedule.run_plans(client, plans[:10], RecordingProgress(), root=Path())  # connections, imports
        port = int(client.scheduler.address.rpartition(":")[2])
        before, memory, started, processor = traffic(port), _memory(), time.perf_counter(), time.process_time()
        schedule.run_plans(client, plans, RecordingProgress(), root=Path())
        seconds, used, after = time.perf_counter() - started, time.process_time() - processor, traffic(port)
    own, others = ((after[k] - before[k]) / trials for k in range(2))
    return {
        "seconds": seconds, "each": 1e3 * seconds / trials, "used": 1e3 * used / trials, "client": own,
        "workers": others, "memory": _memory(), "growth": 1e3 * (_memory() - memory) / trials,
    }  # fmt: skip


def _client() -> Any:
    return cluster.opened_client(None, workers=WORKERS, memory_gb=None, progress=RecordingProgress())


def _task(name: str) -> StepTask:
    """A step with the settings of a usual one."""
    folder = Path("/data/laboratory/gait_study")
    return StepTask(
        trial=name, step="markers", command="markers", path=str(folder / f"{name}.c3d"),
        out=str(folder / "results" / name / "markers"),
        settings={"clusters": "lab.toml", "static": "{folder}/static.c3d"},
        files={"clusters": str(folder / "lab.toml"), "static": str(folder / name[:4] / "static.c3d")}, version="1.0",
    )  # fmt: skip


def _memory() -> float:
    """Resident memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


class _TcpInfo(ctypes.Structure):
    """The beginning of `struct tcp_info` of Linux (include/uapi/linux/tcp.h)."""

    _fields_ = [
        ("states", ctypes.c_uint8 * 8), ("counts", ctypes.c_uint32 * 24), ("rates", ctypes.c_uint64 * 2),
        ("acked", ctypes.c_uint64), ("received", ctypes.c_uint64),
    ]  # fmt: skip


def traffic(port: int) -> tuple[int, int]:
    """Bytes that the sockets of a port of this process have sent and received: to this process, and to others."""
    sockets = list(_sockets())
    here = {each.getsockname()[:2] for each in sockets}
    found = [0, 0]
    for each in sockets:
        if each.getsockname()[1] == port:
            info = _TcpInfo.from_buffer_copy(each.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256))
            found[each.getpeername()[:2] not in here] += info.acked + info.received
    for each in sockets:
        each.close()
    return found[0], found[1]


def _sockets() -> Iterator[socket.socket]:
    """The connected TCP sockets of this process."""
    for name in os.listdir("/proc/self/fd"):
        try:
            if os.readlink(f"/proc/self/fd/{name}").startswith("socket:"):
                each = socket.socket(fileno=os.dup(int(name)))
                if each.family in (socket.AF_INET, socket.AF_INET6) and each.type == socket.SOCK_STREAM:
                    each.getpeername()
                    yield each
        except OSError:  # closed since, or not connected
            continue


# Idle


def _idle(run: Run) -> None:
    table = run.table("Nothing runs", "workers", Column("per worker", "bytes/s", 0), note="Heartbeats, mostly.")
    table.row(str(WORKERS), _child("measure_idle")["bytes"])


def measure_idle() -> dict[str, float]:
    """Watch an idle cluster."""
    with _client() as client:
        port = int(client.scheduler.address.rpartition(":")[2])
        time.sleep(2)
        before, began = traffic(port), time.perf_counter()
        time.sleep(IDLE_S)
        return {"bytes": (sum(traffic(port)) - sum(before)) / WORKERS / (time.perf_counter() - began)}


# Tables


def record_step(task: StepTask) -> StepOutcome:
    """Leave the record and the curves of the real trial, with other values."""
    template = Path(os.environ[_TEMPLATE])
    out = Path(task.out)
    out.mkdir(parents=True)
    shutil.copy(template / "cycles.csv", out / "cycles.csv")
    record = read_step_record(template.with_name(f"{template.name}.json"))
    if record is None:
        raise RuntimeError(f"{template} has no record.")
    rng = np.random.default_rng(zlib.crc32(task.trial.encode()))
    values = tuple(
        replace(each, value=each.value + shift, low=each.low + shift, high=each.high + shift)
        for each, shift in zip(record.values, rng.normal(scale=0.05, size=len(record.values)), strict=True)
    )
    write_step_record(task.record, replace(record, values=values))
    return StepOutcome(trial=task.trial, step=task.step, state="done")


def _tables(run: Run) -> None:
    table = run.table(
        "After the last step", "trials", Column("rows of the table"), Column("time", "s", 1),
        Column("per trial", "ms", 1), Column("largest memory", "MB", 0), Column("of it since the last step", "MB", 0),
        Column("records", "MB", 1), Column("study.csv", "MB", 1), Column("study.parquet", "MB", 1),
        Column("study.html", "MB", 1),
        note="Every trial has the quantities and curves of the real walk; 20 trials per subject, two conditions.",
    )  # fmt: skip
    template = _template(run)
    for trials in run.arguments.trials:
        with tempfile.TemporaryDirectory(dir=run.out) as folder:
            found = _child("measure_tables", folder, trials, **{_TEMPLATE: str(template)})
        table.row(str(trials), *found.values())


def _template(run: Run) -> Path:
    """Run a study of the real walk; the folder of its step."""
    folder = run.out / "walk"
    if not folder.exists():
        walking_study.write_study(folder, run.shared / "data" / "markers" / "functional", 1)
        toml = folder / "study.toml"
        toml.write_text(toml.read_text().partition("[trials")[0])
        study.run_study(folder, workers=1, progress=RecordingProgress())
    return folder / "results" / "S01" / "walk_1" / "markers"


def measure_tables(name: str, trials: int) -> dict[str, float]:
    """Run a study of steps that only write records; what it needs after the last one."""
    folder, seen = Path(name), {}
    (folder / "study.toml").write_text('pattern = "{subject}/{condition}_*.c3d"\n[[steps]]\ncommand = "markers"\n')
    for number in range(trials):
        path = folder / f"S{number // 20:03d}" / f"{('slow', 'fast')[number % 2]}_{number % 20}.c3d"
        path.parent.mkdir(exist_ok=True)
        path.touch()
    schedule.run_step = record_step
    collected = study._collected

    def noted(*given: Any) -> Any:
        seen["began"], seen["memory"] = time.perf_counter(), _memory()
        return collected(*given)

    study._collected = noted
    found = study.run_study(folder, workers=2, progress=RecordingProgress())
    seconds = time.perf_counter() - seen["began"]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
    results = folder / "results"
    sizes = {each: (results / each).stat().st_size / 1e6 for each in ("study.csv", "study.parquet", "study.html")}
    records = sum(path.stat().st_size for path in results.glob("*/*/markers.json")) / 1e6
    return {
        "rows": len(found.rows), "seconds": seconds, "each": 1e3 * seconds / trials, "peak": peak,
        "growth": peak - seen["memory"], "records": records, **sizes,
    }  # fmt: skip


PARTS = {"steps": _steps, "idle": _idle, "tables": _tables}
"""The parts by name."""
