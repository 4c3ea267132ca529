"""Reading of simple YAML: what OpenCV and the metadata of other programs need, without references, tags or code."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from marey.errors import FileProblem
from marey.io.documents import read_text

_KEY = re.compile(r"""^(?P<key>"[^"]*"|'[^']*'|[^\s#:\[\]{},"'][^:#\[\]{}"']*?)\s*:(?:\s+(?P<value>.*))?$""")
"""A key with an optional value."""
_TAG = re.compile(r"^!!?[\w\-.:/]*\s*")
"""A tag before a value, such as `!!opencv-matrix`, which is ignored."""
_DEEPEST = 20
"""Largest depth of nested tables and lists. Chosen by hand: calibrations have three levels."""

Value: TypeAlias = "str | list[Value] | dict[str, Value]"
"""A text, a list, or a table."""


def read_yaml(path: Path, remedy: str) -> dict[str, Value]:
    """Read a YAML file that consists of tables, lists and plain values, such as those of OpenCV.

    Tags are ignored; anchors, references and texts of several lines are errors.

    Args:
        path: The file.
        remedy: Description of a correct file, as a sentence.

    Returns:
        The outermost table; all single values are texts.

    Raises:
        FileProblem: The file cannot be read, or has another form; the message names the line.
    """
    try:
        lines = list(_lines(read_text(path, remedy)))
        value, rest = _block(lines, 0, depth=0)
        if rest < len(lines):
            raise _LineFault(lines[rest].number, "has another indentation than the lines before it")
    except _LineFault as fault:
        raise FileProblem(path, f"cannot be read: line {fault.line} {fault.wrong}", remedy) from fault
    if not isinstance(value, dict):
        raise FileProblem(path, "is not a table of keys and values", remedy)
    return value


class _LineFault(Exception):
    def __init__(self, line: int, wrong: str):
        super().__init__(wrong)
        self.line, self.wrong = line, wrong


@dataclass(frozen=True, kw_only=True)
class _Line:
    number: int
    indent: int
    text: str


def _lines(text: str) -> Iterator[_Line]:
    """Yield the lines with content; a list in brackets that continues on the next lines is joined to one line."""
    pending: list[str] = []
    start, indent = 0, 0
    for number, raw in enumerate(text.splitlines(), 1):
        line = raw.rstrip()
        if not pending and (not line.strip() or line.lstrip().startswith("#") or line.startswith(("%", "---", "..."))):
            continue
        if not pending:
            stripped = line.lstrip(" ")
            start, indent = number, len(line) - len(stripped)
            if stripped.startswith("\t"):
                raise _LineFault(number, "is indented by a tab")
        pending.append(line.strip())
        joined = " ".join(pending)
        if _is_open(pending):
            continue
        pending = []
        yield _Line(number=start, indent=indent, text=joined)
    if pending:
        raise _LineFault(start, "begins a list that is not closed")


def _is_open(parts: list[str]) -> bool:
    """Return whether a bracket of the line is not closed; brackets in quotes do not matter for the files read."""
    return sum(part.count("[") + part.count("{") - part.count("]") - part.count("}") for part in parts) > 0


def _block(lines: list[_Line], at: int, *, depth: int) -> tuple[Value, int]:
    """Parse the lines of one indentation from a position; return the value and the position after it."""
    if at >= len(lines):
        return {}, at
    if depth > _DEEPEST:
        raise _LineFault(lines[at].number, f"is nested in more than {_DEEPEST} levels")
    return _sequence(lines, at, depth) if _is_item(lines[at]) else _mapping(lines, at, depth)


def _is_item(line: _Line) -> bool:
    return line.text == "-" or line.text.startswith("- ")


def _mapping(lines: list[_Line], at: int, depth: int) -> tuple[Value, int]:
    table: dict[str, Value] = {}
    indent = lines[at].indent
    while at < len(lines) and lines[at].indent == indent and not _is_item(lines[at]):
        line = lines[at]
        match = _KEY.match(line.text)
        if match is None:
            raise _LineFault(line.number, f"is not a key with a value: '{line.text[:40]}'")
        key, text = _unquoted(match["key"]), _without_tag(match["value"] or "")
        if key in table:
            raise _LineFault(line.number, f"repeats the key '{key}'")
        at += 1
        if text:
            table[key] = _inline(text, line.number)
        elif at < len(lines) and (lines[at].indent > indent or (lines[at].indent == indent and _is_item(lines[at]))):
            table[key], at = _block(lines, at, depth=depth + 1)
        else:
            table[key] = ""
    return table, at


def _sequence(lines: list[_Line], at: int, depth: int) -> tuple[Value, int]:
    items: list[Value] = []
    indent = lines[at].indent
    while at < len(lines) and lines[at].indent == indent and _is_item(lines[at]):
        line = lines[at]
        text = _without_tag(line.text[1:].strip())
        at += 1
        if text:
            items.append(_inline(text, line.number))
        elif at < len(lines) and lines[at].indent > indent:
            item, at = _block(lines, at, depth=depth + 1)
            items.append(item)
        else:
            items.append("")
    return items, at


def _without_tag(text: str) -> str:
    text = "" if text.startswith("#") else text
    return _TAG.sub("", text)


def _inline(text: str, line: int) -> Value:
    """Parse a value on one line: a text, or a list of texts in brackets."""
    if text.startswith(("&", "*", "|", ">", "{")):
        raise _LineFault(line, f"has a value of an unsupported form: '{text[:20]}'")
    if not text.startswith("["):
        return _unquoted(text.split(" #")[0].strip())
    if not text.endswith("]") or "[" in text[1:]:
        raise _LineFault(line, "has a list that is nested or not closed")
    inside = text[1:-1].strip().rstrip(",")
    return [_unquoted(part.strip()) for part in inside.split(",")] if inside else []


def _unquoted(text: str) -> str:
    return text[1:-1] if len(text) > 1 and text[0] == text[-1] and text[0] in "\"'" else text
