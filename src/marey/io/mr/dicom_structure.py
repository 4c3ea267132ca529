"""The structure of DICOM files (PS3.5, section 7): lengths that a file cannot hold are found before GDCM reads it."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from marey.errors import FileProblem

_PREAMBLE = 128
"""Bytes before the mark `DICM` (PS3.10, section 7.1)."""
_LONG = frozenset((b"OB", b"OD", b"OF", b"OL", b"OV", b"OW", b"SQ", b"SV", b"UC", b"UN", b"UR", b"UT", b"UV"))
"""Value representations whose length has four bytes (PS3.5, table 7.1-1)."""
_SHORT = frozenset((
    b"AE", b"AS", b"AT", b"CS", b"DA", b"DS", b"DT", b"FD", b"FL", b"IS", b"LO", b"LT", b"PN", b"SH", b"SL", b"SS",
    b"ST", b"TM", b"UI", b"UL", b"US",
))  # fmt: skip
"""The other value representations (PS3.5, table 6.2-1), whose length has two bytes."""
_UNDEFINED = 0xFFFFFFFF
"""Length of what ends by a delimiter."""
_ITEM, _ITEM_END, _SEQUENCE_END = (0xFFFE, 0xE000), (0xFFFE, 0xE00D), (0xFFFE, 0xE0DD)
"""Tags of items and delimiters."""
_SYNTAX = (0x0002, 0x0010)
"""Tag of the transfer syntax."""
_PIXELS = (0x7FE0, 0x0010)
"""Tag of the pixels."""
_IMPLICIT = b"1.2.840.10008.1.2"
"""The transfer syntax without value representations."""
_OTHERS = (b"1.2.840.10008.1.2.2", b"1.2.840.10008.1.2.1.99")
"""Big-endian and deflated files, of which only the beginning is checked."""
_DEEPEST = 50
"""Most sequences within each other. Chosen by hand."""


class _Broken(Exception):
    """A length that reaches beyond the end of the file, or a structure that is none."""


@dataclass(frozen=True)
class _Element:
    tag: tuple[int, int]
    is_sequence: bool
    length: int
    start: int
    """First byte of the value."""


def require_dicom_structure(path: Path) -> None:
    """Check that the elements of a file lie within it; a file without the mark of DICOM is left to the reader.

    Args:
        path: The file.

    Raises:
        FileProblem: It cannot be read, or an element is longer than the file.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FileProblem(path, f"cannot be read ({error.strerror})", "Check its permissions.") from error
    if content[_PREAMBLE : _PREAMBLE + 4] != b"DICM":
        return
    try:
        _walk_file(content)
    except _Broken as error:
        raise FileProblem(path, f"is damaged ({error})", "Copy or export the series again.") from error


def _walk_file(content: bytes) -> None:
    """Walk through the group of the file's own elements, then through the others."""
    place, syntax = _PREAMBLE + 4, b""
    while place < len(content) and content[place : place + 2] == b"\x02\x00":
        element = _element(content, place, explicit=True)
        place = _end(content, element, explicit=True, depth=0)
        if element.tag == _SYNTAX:
            syntax = content[element.start : place].strip(b"\0 ")
    if syntax not in _OTHERS:
        for element in _elements(content, place, len(content), explicit=syntax != _IMPLICIT, depth=0):
            if element.tag == _PIXELS:
                return  # what may follow is padding


def _elements(content: bytes, place: int, end: int, *, explicit: bool, depth: int) -> Iterator[_Element]:
    """Iterate over the elements from a place to an end, or to the end of their item."""
    if depth > _DEEPEST:
        raise _Broken("its sequences are nested too deeply")
    while place < end:
        element = _element(content, place, explicit=explicit)
        if element.tag != _ITEM_END:
            place = _end(content, element, explicit=explicit, depth=depth)
        yield element
        if element.tag == _ITEM_END:
            return


def _element(content: bytes, place: int, *, explicit: bool) -> _Element:
    """Read the head of an element."""
    if place + 8 > len(content):
        raise _Broken("it ends within an element")
    try:
        group, number = struct.unpack_from("<HH", content, place)
        kind = content[place + 4 : place + 6]
        if not explicit or group == _ITEM[0]:
            (length,), start = struct.unpack_from("<I", content, place + 4), place + 8
            return _Element((group, number), length == _UNDEFINED and group != _ITEM[0], length, start)
        if kind in _LONG:
            (length,), start = struct.unpack_from("<I", content, place + 8), place + 12
        elif kind in _SHORT:
            (length,), start = struct.unpack_from("<H", content, place + 6), place + 8
        else:
            raise _Broken(f"its element ({group:04x},{number:04x}) is of no known kind")
    except struct.error as error:
        raise _Broken("it ends within an element") from error
    return _Element((group, number), kind == b"SQ" or length == _UNDEFINED, length, start)


def _end(content: bytes, element: _Element, *, explicit: bool, depth: int) -> int:
    """Return the first byte behind an element, which must lie within the file."""
    if element.length != _UNDEFINED:
        end = element.start + element.length
        if end > len(content):
            shown = f"({element.tag[0]:04x},{element.tag[1]:04x})"
            raise _Broken(f"its element {shown} has {element.length} bytes, and the file {len(content)}")
        return end
    place = element.start
    while True:
        item = _element(content, place, explicit=explicit)
        if item.tag == _SEQUENCE_END:
            return item.start
        if item.tag != _ITEM:
            raise _Broken("a sequence holds no items")
        if item.length != _UNDEFINED:
            place = _end(content, item, explicit=explicit, depth=depth)
            continue
        within = list(_elements(content, item.start, len(content), explicit=explicit, depth=depth + 1))
        if not within or within[-1].tag != _ITEM_END:
            raise _Broken("an item has no end")
        place = within[-1].start
