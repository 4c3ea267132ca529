"""The structure of a C3D before a library reads it."""

import struct

import ezc3d
import pytest
from tests.trials import marker_points, write_trial

from marey.errors import FileProblem
from marey.io.markers.c3d import open_c3d
from marey.io.markers.c3d_structure import c3d_structure


@pytest.fixture
def path(tmp_path):
    points = {name: of_marker[:6] for name, of_marker in marker_points().items()}
    return write_trial(tmp_path / "trial.c3d", points, force=True)


def test_the_parameters_are_those_that_the_library_reads(path):
    structure, read = c3d_structure(path.read_bytes()), ezc3d.c3d(str(path))["parameters"]
    for group in ("POINT", "ANALOG"):
        for name in ("USED", "RATE"):
            assert structure.number(group, name) == read[group][name]["value"][0]
    assert structure.number("POINT", "LABELS") is None
    assert structure.number("POINT", "NONSENSE") is None


def test_the_end_is_that_of_the_file(path):
    content = path.read_bytes()
    structure = c3d_structure(content)
    assert structure.is_complete
    # The file ends with the block of the last frame.
    assert len(content) - 512 < structure.end <= len(content)
    assert not c3d_structure(content[: structure.end - 1]).is_complete


def changed(content: bytes, group: str, name: str, value: bytes) -> bytes:
    """Replace the first bytes of the values of a parameter."""
    parameter = c3d_structure(content).parameters[group, name]
    record = content.index(bytes([parameter.group]) + name.encode())
    start = content.index(parameter.values, record + 1 + len(name) + 4)
    return content[:start] + value + content[start + len(value) :]


@pytest.mark.parametrize(
    ("group", "name", "value", "wrong"),
    [
        ("POINT", "USED", struct.pack("<h", 30_000), "is truncated"),
        ("ANALOG", "USED", struct.pack("<h", 30_000), "does not have one number for each"),
        ("ANALOG", "RATE", struct.pack("<f", 1e30), "has ANALOG:RATE = "),
    ],
)
def test_sizes_that_the_file_cannot_hold_are_refused(path, group, name, value, wrong):
    path.write_bytes(changed(path.read_bytes(), group, name, value))
    with pytest.raises(FileProblem, match=wrong):
        open_c3d(path)


@pytest.mark.parametrize(
    ("place", "value", "wrong"),
    [
        (0, b"\x00", "begin within the header"), (0, b"\x01", "begin within the header"), (1, b"\x51", "second byte"),
        (512 + 3, b"\x10", "byte order has the unknown number 16"),
    ],
)  # fmt: skip
def test_a_damaged_head_is_named(path, place, value, wrong):
    content = path.read_bytes()
    path.write_bytes(content[:place] + value + content[place + 1 :])
    with pytest.raises(FileProblem, match=wrong):
        open_c3d(path)


@pytest.mark.parametrize(("group", "name"), [("POINT", "USED"), ("POINT", "LABELS")])
def test_a_parameter_that_the_library_needs_has_its_type(path, group, name):
    content = path.read_bytes()
    record = content.index(bytes([c3d_structure(content).parameters[group, name].group]) + name.encode())
    kind = record + 1 + len(name) + 2
    path.write_bytes(content[:kind] + (b"\x01" if name == "LABELS" else b"\xff") + content[kind + 1 :])
    with pytest.raises(FileProblem, match=f"its parameter {group}:{name}"):
        open_c3d(path)


def test_a_text_without_a_length_is_refused(path):
    content = path.read_bytes()
    dimensions = content.index(b"UNITS", content.index(b"ANALOG")) + len("UNITS") + 3
    path.write_bytes(content[:dimensions] + bytes(3) + content[dimensions + 3 :])
    with pytest.raises(FileProblem, match="its parameter ANALOG:UNITS is a text without a length"):
        open_c3d(path)


def test_a_description_that_the_library_cannot_read_is_refused(path):
    content = path.read_bytes()
    step = content.index(b"ANALOG") + len("ANALOG")
    path.write_bytes(content[:step] + b"\0\0\x80" + content[step + 3 :])
    with pytest.raises(FileProblem, match="the description of ANALOG has more than 127 characters"):
        open_c3d(path)


def test_every_analog_channel_needs_a_scale(path):
    content = path.read_bytes()
    parameter = c3d_structure(content).parameters["ANALOG", "SCALE"]
    name = bytes([parameter.group]) + b"SCALE"
    path.write_bytes(content.replace(name, bytes([parameter.group]) + b"SCALX"))
    with pytest.raises(FileProblem, match="ANALOG:SCALE does not have one number for each of 2 channels"):
        open_c3d(path)


def test_a_record_that_is_longer_than_its_place_is_refused(path):
    content = path.read_bytes()
    at = content.index(b"USED") + 4
    path.write_bytes(content[:at] + struct.pack("<h", 1) + content[at + 2 :])
    with pytest.raises(FileProblem, match="states an impossible length"):
        open_c3d(path)
