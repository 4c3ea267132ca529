"""One bad input, and changes of the prepared folder that make an input bad."""

import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

Change = Callable[[Path], None]
"""Changes a file of the prepared folder, whose path is the argument."""


@dataclass(frozen=True, kw_only=True)
class BadInput:
    """A command as it is typed in the prepared folder, and what must happen."""

    typed: str
    """The words after `marey`, quoted as in a shell."""
    shown: tuple[str, ...]
    """What the message must contain: the file or option, and what is wrong."""
    changes: tuple[Change, ...] = ()
    """What makes the input bad before the command runs."""
    code: int = 2
    """The exit code: 2 for wrong input, 3 for an unusable result."""
    kept: tuple[str, ...] = ()
    """Beginnings of the names of files that may be written: results that are documented for this case."""
    how: str = "here"
    """`here`, in the process of the benchmark; `started`, as a process; `user`, without rights of an administrator."""
    why: str = ""
    """What the changes are, for the table."""


def bad(typed: str, *shown: str, **given: Any) -> BadInput:
    """Describe a bad input; `change` stands for one change or several."""
    change = given.pop("change", ())
    return BadInput(typed=typed, shown=shown, changes=(change,) if callable(change) else tuple(change), **given)


def each(pattern: str, *values: Sequence[str], **given: Any) -> tuple[BadInput, ...]:
    """Describe one bad input for each value, of which the first part replaces `{}` and the others are shown."""
    return tuple(bad(pattern.format(first), *shown, **given) for first, *shown in values)


def text(name: str, content: str, encoding: str = "utf-8") -> Change:
    """Write a text file."""
    return raw(name, content.encode(encoding))


def raw(name: str, content: bytes) -> Change:
    """Write a file of bytes."""

    def change(folder: Path) -> None:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)

    return change


def document(name: str, content: object) -> Change:
    """Write a JSON file."""
    return text(name, json.dumps(content))


def table(name: str, pattern: str, rows: int) -> Change:
    """Append a row several times, with its number in place of `{}`."""

    def change(folder: Path) -> None:
        with (folder / name).open("a", encoding="utf-8") as file:
            file.writelines(pattern.format(number) + "\n" for number in range(rows))

    return change


def archive(name: str, arrays: Mapping[str, object]) -> Change:
    """Write an NPZ."""

    def change(folder: Path) -> None:
        np.savez(folder / name, **{key: np.asarray(value) for key, value in arrays.items()})

    return change


def rewritten(name: str, edit: Callable[[dict[str, Any]], None]) -> Change:
    """Change the arrays of an NPZ, or the tree of a JSON file."""

    def change(folder: Path) -> None:
        if name.endswith(".json"):
            content = json.loads((folder / name).read_text())
            edit(content)
            (folder / name).write_text(json.dumps(content))
            return
        with np.load(folder / name, allow_pickle=False) as file:
            arrays = dict(file)
        edit(arrays)
        np.savez(folder / name, **arrays)

    return change


def swap(name: str, old: str, new: str, *, count: int = -1) -> Change:
    """Replace a part of a text file, which must be there."""

    def change(folder: Path) -> None:
        content = (folder / name).read_bytes()
        if old.encode() not in content:
            raise ValueError(f"{name} has no {old!r}")
        (folder / name).write_bytes(content.replace(old.encode(), new.encode(), count))

    return change


def cut(name: str, length: int) -> Change:
    """Keep only the beginning of a file."""
    return lambda folder: os.truncate(folder / name, length)


def gone(*names: str) -> Change:
    """Remove files or folders."""

    def change(folder: Path) -> None:
        for name in names:
            place = folder / name
            shutil.rmtree(place) if place.is_dir() else place.unlink()

    return change


def folder_at(name: str) -> Change:
    """Put an empty folder in the place of a file."""

    def change(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        (folder / name).mkdir(parents=True)

    return change


def copied(name: str, to: str) -> Change:
    """Copy a file or a folder of the prepared folder."""

    def change(folder: Path) -> None:
        (folder / to).parent.mkdir(parents=True, exist_ok=True)
        if (folder / name).is_dir():
            shutil.copytree(folder / name, folder / to, dirs_exist_ok=True)
        else:
            shutil.copy(folder / name, folder / to)

    return change


def rights(name: str, mode: int) -> Change:
    """Set the rights of a file or folder."""
    return lambda folder: (folder / name).chmod(mode)
