"""Which files of a folder marey wrote, by the run.json in it, and whether results may be written there."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from marey.errors import FileProblem
from marey.wording import listed

RECORD = "run.json"
"""Name of the file that records the run."""
_OTHER_FOLDER = "Give another folder for the results (--out)."
"""Remedy if results cannot be written to a folder."""


def read_record(folder: Path) -> dict[str, Any]:
    """Return the record of the last run in a folder.

    Args:
        folder: A folder.

    Returns:
        The content of `run.json`; empty if there is none, or if it is not a record.
    """
    try:
        record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return record if isinstance(record, dict) and isinstance(record.get("files", []), list) else {}


def records_in(folder: Path) -> list[dict[str, Any]]:
    """Return the records of all runs that have results in a folder, the last run first.

    Args:
        folder: A folder.
    """
    record = read_record(folder)
    earlier = record.pop("earlier", {})
    each = [record, *(earlier.values() if isinstance(earlier, dict) else ())]
    return [run for run in each if isinstance(run, dict) and isinstance(run.get("files"), list)]


def files_of_runs(folder: Path) -> frozenset[str]:
    """Return the files in a folder that marey wrote, as paths relative to the folder with slashes.

    Args:
        folder: A folder.
    """
    return frozenset(str(name) for run in records_in(folder) for name in run["files"])


def require_own_folder(out: Path, inputs: Iterable[Path]) -> None:
    """Check that the folder for the results is not one of the inputs of the run, and holds none of them.

    Results that marey wrote to the folder may be inputs, such as a surface from which a body is estimated.

    Args:
        out: Folder for the results, which need not exist.
        inputs: The input files and folders.

    Raises:
        FileProblem: The folder cannot be used.
    """
    folder = out.resolve()
    resolved = [path.resolve() for path in inputs]
    if folder in resolved:
        raise FileProblem(out, "is an input of this run, so its results would mix with inputs", _OTHER_FOLDER)
    there = {path.name for path in resolved if path.parent == folder and path.is_file()}
    mixed = sorted(there - files_of_runs(out)) if there else []
    if mixed:
        wrong = f"contains inputs of this run ({listed(mixed, most=3)}), which results could replace"
        raise FileProblem(out, wrong, _OTHER_FOLDER)
