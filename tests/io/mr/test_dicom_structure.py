"""Files of DICOM whose elements are longer than the file, or of no kind, are refused before a library reads them."""

import struct

import pytest

from marey.errors import FileProblem
from marey.io.mr.dicom_structure import require_dicom_structure

EXPLICIT, IMPLICIT = b"1.2.840.10008.1.2.1\0", b"1.2.840.10008.1.2\0"
ITEM, ITEM_END, SEQUENCE_END = 0xE000FFFE, 0xE00DFFFE, 0xE0DDFFFE


def explicit(group: int, number: int, kind: bytes, value: bytes, length: int | None = None) -> bytes:
    stated = len(value) if length is None else length
    head = struct.pack("<HH", group, number) + kind
    return head + (struct.pack("<HI", 0, stated) if kind in (b"OW", b"SQ") else struct.pack("<H", stated)) + value


def file_of(syntax: bytes, elements: bytes) -> bytes:
    return bytes(128) + b"DICM" + explicit(2, 0x10, b"UI", syntax) + elements


ENDED = struct.pack("<II", ITEM, 0xFFFFFFFF) + explicit(8, 0x60, b"CS", b"MR") + struct.pack("<II", ITEM_END, 0)
ENDED += struct.pack("<II", SEQUENCE_END, 0)
PIXELS = explicit(0x7FE0, 0x10, b"OW", bytes(8))
PACKED = struct.pack("<IIIII", ITEM, 0, ITEM, 4, 1) + struct.pack("<II", SEQUENCE_END, 0)


@pytest.mark.parametrize(
    "content",
    [
        b"a text", file_of(EXPLICIT, explicit(8, 0x60, b"CS", b"MR") + PIXELS),
        file_of(IMPLICIT, struct.pack("<HHI", 8, 0x60, 2) + b"MR"),
        file_of(EXPLICIT, explicit(8, 0x1140, b"SQ", ENDED, 0xFFFFFFFF) + PIXELS),
        file_of(EXPLICIT, explicit(0x7FE0, 0x10, b"OW", PACKED, 0xFFFFFFFF)),
    ],
)  # fmt: skip
def test_files_that_are_whole_are_left_to_the_library(tmp_path, content):
    (tmp_path / "a.dcm").write_bytes(content)
    assert require_dicom_structure(tmp_path / "a.dcm") is None  # type: ignore[func-returns-value]


@pytest.mark.parametrize(
    ("content", "wrong"),
    [
        (file_of(EXPLICIT, explicit(0x7FE0, 0x10, b"OW", b"", 2**31)), r"\(7fe0,0010\) has 2147483648 bytes"),
        (file_of(IMPLICIT, struct.pack("<HHI", 8, 0x60, 10**9)), r"\(0008,0060\) has 1000000000 bytes"),
        (file_of(EXPLICIT, explicit(8, 0x60, b"<I", b"MR")), "of no known kind"),
        (file_of(EXPLICIT, PIXELS[:5]), "ends within an element"),
        (file_of(EXPLICIT, explicit(8, 0x1140, b"SQ", ENDED[:-8], 0xFFFFFFFF)), "ends within an element"),
        (file_of(EXPLICIT, explicit(8, 0x1140, b"SQ", PIXELS, 0xFFFFFFFF)), "holds no items"),
        (file_of(EXPLICIT, 60 * (explicit(8, 0x1140, b"SQ", struct.pack("<II", ITEM, 0xFFFFFFFF), 0xFFFFFFFF))),
         "nested too deeply"),
    ],
)  # fmt: skip
def test_a_broken_structure_is_one_line(tmp_path, content, wrong):
    (tmp_path / "a.dcm").write_bytes(content)
    with pytest.raises(FileProblem, match=wrong):
        require_dicom_structure(tmp_path / "a.dcm")
