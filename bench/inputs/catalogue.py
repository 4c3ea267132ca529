"""Bad inputs of every command: one line, the exit code, and a folder that stays as it was.

A folder is filled with small valid inputs, which are made. Each entry changes something in it (or nothing), and types a
command there. Clean is an entry whose command ends with the stated exit code; writes exactly one line to the standard
error, which names the file or option, what is wrong, and what would be right; writes no traceback; prints nothing to
the standard output; leaves the folder as it was; and ends within `--seconds`. Commands run in forked processes with
bounded memory, some as programs of their own, and some without the rights of an administrator.
"""

import argparse
import ctypes
import importlib
import os
import pkgutil
import re
import resource
import shlex
import shutil
import signal
import struct
import subprocess
import sys
import time
import traceback
from collections import Counter
from pathlib import Path

from bench.declaration import Bench
from bench.inputs.entries import (
    calibrations,
    knees,
    markers,
    motions,
    options,
    settings,
    shapes,
    trial_files,
    trials,
)
from bench.inputs.entries.entry import BadInput
from bench.inputs.entries.scene import write_scene
from bench.recording import Column, Run
from marey.cli import main
from marey.cli.work import NOT_USABLE

BENCH = Bench(
    measures="Bad inputs of every command: one line, the exit code, and a folder that stays as it was.",
    sources=("src/marey/cli", "src/marey/io", "src/marey/pipelines", "bench/inputs/entries"),
    minutes=3,
    data=False,
)
MEMORY = 6 * 2**30
"""Memory that a command may use [bytes]."""
EVERY = 100
"""Number of entries after which the progress is printed."""
CAPABILITIES = 0x20080522
"""Version of the kernel's interface of capabilities, with 64 of them."""
ENTRIES: tuple[BadInput, ...] = (
    *options.ENTRIES, *trials.ENTRIES, *settings.ENTRIES, *trial_files.ENTRIES, *calibrations.ENTRIES,
    *markers.ENTRIES, *shapes.ENTRIES, *motions.ENTRIES, *knees.ENTRIES,
)  # fmt: skip
"""All entries of the catalogue."""
REMEDY = re.compile(r"should|must|See marey|[.;] [A-Z'\"`]|[;:] |--help")
"""What follows the fault: what would be right."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("words", nargs="*", help="only entries whose command contains one of these")
    parser.add_argument("--seconds", type=int, default=30, help="longest time of one command")


def run(run: Run) -> None:
    """Type all entries, count them by command, and list the lines."""
    chosen = [e for e in ENTRIES if not run.arguments.words or any(w in e.typed for w in run.arguments.words)]
    prepared = run.out / "prepared"
    shutil.rmtree(prepared, ignore_errors=True)
    prepared.mkdir(parents=True)
    write_scene(prepared)
    run.out.chmod(0o755)
    _load_everything()
    lines = []
    for number, entry in enumerate(chosen, start=1):
        if number % EVERY == 0:
            run.report(f"{number} of {len(chosen)}")
        began = time.monotonic()
        lines.append((entry, *_outcome(entry, prepared, run.arguments.seconds)))
        if lines[-1][2]:
            run.report(f"{entry.typed} [{entry.why}] {lines[-1][2]}: {lines[-1][1]} ({time.monotonic() - began:.1f} s)")
    counts = run.table("Bad inputs", "command", Column("tried"), Column("clean"), Column("failing"))
    tried = Counter(command_of(entry.typed) for entry in chosen)
    failing = Counter(command_of(entry.typed) for entry, _, fault in lines if fault)
    for command, count in tried.items():
        counts.row(command, count, count - failing[command], failing[command])
    counts.row("all", len(chosen), len(chosen) - failing.total(), failing.total())
    listed = run.table(
        "What is written", ("typed", "changed before"), Column("code"), Column("line"), Column("fault"),
        note=f"Not listed: {len(options.GENERATED)} entries for unknown options, options without a value or with "
        "letters for a number, and missing arguments.",
    )  # fmt: skip
    for entry, line, fault in lines:
        if entry in options.GENERATED and not fault:
            continue
        typed, written = (text.encode("utf-8", "backslashreplace").decode() for text in (entry.typed, line))
        listed.row((typed, entry.why), entry.code, written, fault or None)


def command_of(typed: str) -> str:
    """Return the name of the command that is typed."""
    words = [word for word in shlex.split(typed) if not word.startswith("-")]
    return " ".join(words[: 2 if words[:1] == ["knee"] else 1]) or "none"


def _load_everything() -> None:
    """Import what commands import when they run, so that a forked process starts at once."""
    for package in ("marey.pipelines", "marey.io", "marey.view"):
        module = importlib.import_module(package)
        for found in pkgutil.walk_packages(module.__path__, f"{package}."):
            importlib.import_module(found.name)


def _outcome(entry: BadInput, prepared: Path, seconds: int) -> tuple[str, str]:
    """Type an entry in a copy of the prepared folder; return the line, and what is wrong with what happened."""
    folder = prepared.with_name("typed")
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(prepared, folder)
    for change in entry.changes:
        change(folder)
    before = _content(folder)
    code, out, error = _typed(entry, folder, seconds)
    after = _content(folder)
    # Notes on the input, of which there may be several, come before the line.
    shown = [line for line in error.splitlines() if line.strip() and not line.startswith("Note: ")]
    reasons = reasons_of(entry, shown)
    line = " ".join(reasons[-1].replace(f"{folder}/", "").split()) if reasons else ""
    return line[:600], "; ".join(_faults(entry, code, out, shown, before, after))


def reasons_of(entry: BadInput, shown: list[str]) -> list[str]:
    """Return the lines that state what is wrong: those of a verdict without its head and the name of its page."""
    if entry.code != NOT_USABLE or shown[:1] != ["Verdict: not usable"]:
        return shown
    return [line for line in shown[1:] if not line.startswith("Report: ")]


def _faults(
    entry: BadInput, code: int, out: str, shown: list[str], before: dict[str, bytes], after: dict[str, bytes]
) -> list[str]:  # fmt: skip
    faults = [f"exit code {code}"] if code != entry.code else []
    if any("Traceback" in line for line in shown):
        return [*faults, "traceback"]
    reasons = reasons_of(entry, shown)
    line = reasons[-1] if reasons else ""
    faults += [f"{len(reasons)} lines"] if len(reasons) != 1 else []
    faults += [f"does not contain {text!r}" for text in entry.shown if text not in line]
    faults += [] if REMEDY.search(line) else ["no remedy"]
    faults += ["prints to the standard output"] if out.strip() and not entry.kept else []
    changed = sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))
    left = [name for name in changed if not name.startswith(entry.kept or "//")]
    return [*faults, *([f"left: {', '.join(left[:3])}"] if left else [])]


def _typed(entry: BadInput, folder: Path, seconds: int) -> tuple[int, str, str]:
    """Run a command; return its exit code and what it wrote."""
    words = shlex.split(entry.typed, comments=False)
    outputs = folder.with_name("out.txt"), folder.with_name("error.txt")
    if entry.how == "started":
        code = _started(words, folder, outputs, seconds)
    else:
        code = _forked(words, folder, outputs, seconds, user=entry.how == "user")
    out, error = (path.read_text(encoding="utf-8", errors="replace") for path in outputs)
    return code, out, error


def _started(words: list[str], folder: Path, outputs: tuple[Path, Path], seconds: int) -> int:
    """Run a command as a process of its own."""
    with outputs[0].open("w") as out, outputs[1].open("w") as error:
        command = [sys.executable, "-m", "marey", *(os.fsencode(word) for word in words)]
        return subprocess.run(command, cwd=folder, stdout=out, stderr=error, timeout=seconds, check=False).returncode


def _forked(words: list[str], folder: Path, outputs: tuple[Path, Path], seconds: int, *, user: bool) -> int:
    """Run a command in a copy of this process, which has the modules loaded; 124 if it does not end."""
    child = os.fork()
    if child == 0:
        _become(words, folder, outputs, user=user)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return 124


def _become(words: list[str], folder: Path, outputs: tuple[Path, Path], *, user: bool) -> None:
    """Be the program: run the command with the files as its outputs, and end."""
    code = 1
    try:
        for number, path in enumerate(outputs, start=1):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666), number)
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        os.chdir(folder)
        if user:
            _without_rights()
        code = main.run(words)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _without_rights() -> None:
    """Give up what lets an administrator write where the rights of a folder forbid it."""
    head = struct.pack("<Ii", CAPABILITIES, 0)
    if ctypes.CDLL(None, use_errno=True).capset(head, bytes(24)):
        raise OSError(ctypes.get_errno(), "the rights of an administrator cannot be given up")


def _content(folder: Path) -> dict[str, bytes]:
    """Return the files of a folder by their relative names, with the folders, which have no content."""
    found = {}
    for base, folders, names in os.walk(folder):
        for name in (*folders, *names):
            path = Path(base) / name
            found[path.relative_to(folder).as_posix()] = path.read_bytes() if path.is_file() else b""
    return found
