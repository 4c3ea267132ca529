"""The structure of a C3D file, checked before a library reads it.

The library does not check the sizes that a file states, and ends the program where they are wrong. Here the parameter
section is read record by record, and the sizes that it states are compared with the length of the file.
"""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass

BLOCK = 512
"""Length of a block of a C3D [bytes]."""
_KEY = 0x50
"""Second byte of a C3D file."""
_INTEL, _DEC, _MIPS = 84, 85, 86
"""Numbers of the byte orders: those of Intel, DEC and MIPS processors."""
_WIDTHS = {-1: 1, 1: 1, 2: 2, 4: 4}
"""Length of a value by the type of a parameter [bytes]."""
_MOST_DIMENSIONS = 7
"""Largest number of dimensions of a parameter, by the format."""
BYTES_OF_A_ROTATION = 17 * 4
"""Length of a rotation of one segment in a frame: 16 numbers of a matrix and a residual [bytes]."""
_NUMBERS = {
    "POINT": ("USED", "SCALE", "RATE", "DATA_START", "FRAMES"), "ANALOG": ("USED", "GEN_SCALE", "RATE"),
    "FORCE_PLATFORM": ("USED",), "ROTATION": ("USED", "DATA_START", "RATE", "RATIO"),
}  # fmt: skip
"""Parameters that hold at least one number, if they are there; the library ends the program otherwise."""
_TEXTS = {"POINT": ("LABELS",), "ANALOG": ("LABELS", "FORMAT"), "ROTATION": ("LABELS", "DESCRIPTIONS")}
"""Parameters that hold lists of texts, if they are there; the library ends the program otherwise."""
_MOST_DESCRIPTION = 127
"""Longest description that the library reads; of a longer one it reserves 4 GB."""
_MOST_SCALES = 255
"""Largest number of values along a dimension of a parameter, by the format."""
_LARGEST_RATIO = 10_000
"""Largest number of analog samples, or of rotations, per frame. Chosen by hand: force plates have at most some tens."""


@dataclass(frozen=True)
class _Parameter:
    """A parameter of the file."""

    group: int
    """Number of its group."""
    name: str
    """Name in capitals."""
    kind: int
    """Type: -1 text, 1 bytes, 2 integers, 4 real numbers."""
    dimensions: int
    """Number of dimensions of its values."""
    values: bytes
    """The values as they are in the file."""


@dataclass(frozen=True)
class C3dStructure:
    """What a C3D file states about its own size."""

    content: bytes
    """The whole file."""
    order: str
    """Byte order of integers as `struct` writes it."""
    processor: int
    """Number of the byte order."""
    parameters: dict[tuple[str, str], _Parameter]
    """The parameters by the names of group and parameter."""

    def number(self, group: str, name: str) -> float | None:
        """Return the first number of a parameter; None if the file does not have it, or not as a number."""
        parameter = self.parameters.get((group, name))
        if parameter is None or parameter.kind not in (1, 2, 4) or len(parameter.values) < parameter.kind:
            return None
        if parameter.kind == 4:
            return self._real(parameter.values)
        code = "b" if parameter.kind == 1 else f"{self.order}H"
        return float(struct.unpack_from(code, parameter.values)[0])

    def _real(self, values: bytes) -> float:
        if self.processor == _DEC:
            # The halves of a DEC number are exchanged, and its exponent is larger by 2.
            return float(struct.unpack("<f", values[2:4] + values[:2])[0]) / 4
        return float(struct.unpack_from(f"{self.order}f", values)[0])

    @property
    def is_complete(self) -> bool:
        """Whether the file is as long as its header and its parameters state."""
        return self.end <= len(self.content)

    @property
    def end(self) -> int:
        """The length that header and parameters together require [bytes].

        Raises:
            ValueError: They state something impossible.
        """
        points, analogs, first, last = struct.unpack_from(f"{self.order}4H", self.content, 2)
        start, ratio = struct.unpack_from(f"{self.order}2H", self.content, 16)
        scale = self._real(self.content[12:16])
        frames = last - first + 1
        if stated := self.number("POINT", "FRAMES"):
            frames = max(frames, round(self._possible(stated, "POINT:FRAMES")))
        if (used := self.number("POINT", "USED")) is not None:
            points = max(points, round(self._possible(used, "POINT:USED")))
        if channels := self.number("ANALOG", "USED"):
            rates = [self.number(group, "RATE") or 0.0 for group in ("POINT", "ANALOG")]
            ratio = max(ratio, round(self._possible(rates[1] / rates[0], "ANALOG:RATE")) if rates[0] > 0 else 0)
            analogs = max(analogs, round(self._possible(channels, "ANALOG:USED")) * ratio)
        if frames < 0 or start < 1 or ratio > _LARGEST_RATIO:
            raise ValueError(f"it states {frames} frames from block {start} with {ratio} analog samples each")
        end = (start - 1) * BLOCK + frames * (4 * points + analogs) * (4 if scale < 0 else 2)
        return int(max(end, self._end_of_rotations(frames)))

    def _end_of_rotations(self, frames: int) -> int:
        used, start = self.number("ROTATION", "USED"), self.number("ROTATION", "DATA_START")
        if not used:
            return 0
        if start is None or start < 1:
            raise ValueError("it does not state where its rotations begin")
        ratio = self.number("ROTATION", "RATIO")
        if ratio is None and (rate := self.number("ROTATION", "RATE")):
            ratio = rate / max(self.number("POINT", "RATE") or rate, 1e-6)
        each = round(self._possible(1.0 if ratio is None else ratio, "ROTATION:RATIO"))
        count = round(self._possible(used, "ROTATION:USED"))
        return (round(start) - 1) * BLOCK + frames * count * max(each, 1) * BYTES_OF_A_ROTATION

    def _possible(self, value: float, name: str) -> float:
        """Return a number that a file can hold, or raise an error."""
        if not (math.isfinite(value) and 0 <= value < 2**31):
            raise ValueError(f"it has {name} = {value:g}")
        return value


def c3d_structure(content: bytes) -> C3dStructure:
    """Read the parameters of a C3D.

    Args:
        content: The whole file.

    Returns:
        What the file states about itself.

    Raises:
        ValueError: It is not a C3D, or its parameters are damaged.
        IndexError: It ends too early.
        struct.error: It ends too early.
    """
    if content[1] != _KEY:
        raise ValueError("its second byte is not that of a C3D file")
    first = (content[0] - 1) * BLOCK
    if first < BLOCK:
        raise ValueError("its parameters begin within the header")
    processor = content[first + 3]
    if processor not in (_INTEL, _DEC, _MIPS):
        raise ValueError(f"its byte order has the unknown number {processor}")
    order = ">" if processor == _MIPS else "<"
    groups: dict[int, str] = {}
    found: list[_Parameter] = []
    for number, name, parameter in _records(content, first + 4, order):
        if parameter is None:
            groups[number] = name
        else:
            found.append(parameter)
    missing = sorted({each.group for each in found} - set(groups))
    if missing:
        raise ValueError(f"it has parameters of the group {missing[0]}, which does not exist")
    structure = C3dStructure(
        content, order, processor, {(groups[each.group], each.name): each for each in found}
    )  # fmt: skip
    _require_types(structure)
    scalar = next((each for each in found if each.kind == -1 and each.dimensions == 0), None)
    if scalar is not None:  # the library ends the program
        raise ValueError(f"its parameter {groups[scalar.group]}:{scalar.name} is a text without a length")
    return structure


def _require_types(structure: C3dStructure) -> None:
    """Require the types of the parameters that the library uses, or raise a ValueError."""
    for group, names in _NUMBERS.items():
        for name in names:
            if (group, name) in structure.parameters and structure.number(group, name) is None:
                raise ValueError(f"its parameter {group}:{name} is no number")
    for group, names in _TEXTS.items():
        for name in names:
            given = structure.parameters.get((group, name))
            if given is not None and (given.kind != -1 or given.dimensions == 0):
                raise ValueError(f"its parameter {group}:{name} is no list of texts")
    for name in ("USED", "RATE"):
        if ("POINT", name) not in structure.parameters:
            raise ValueError(f"it has no parameter POINT:{name}")
    channels = min(structure.number("ANALOG", "USED") or 0, _MOST_SCALES)
    for name, widths in (("SCALE", (4,)), ("OFFSET", (2, 4))):
        given = structure.parameters.get(("ANALOG", name))
        if channels and (given is None or given.kind not in widths or len(given.values) < channels * given.kind):
            raise ValueError(f"its parameter ANALOG:{name} does not have one number for each of {channels:g} channels")


def _records(content: bytes, at: int, order: str) -> Iterator[tuple[int, str, _Parameter | None]]:
    """Yield group number, name, and the parameter of each record; None for that of a group."""
    while True:
        length, number = struct.unpack_from("2b", content, at)
        if length == 0:
            return
        name_end = at + 2 + abs(length)
        name = content[at + 2 : name_end].decode("latin-1").strip().upper()
        (step,) = struct.unpack_from(f"{order}h", content, name_end)
        body = name_end + 2
        if number < 0:
            yield -number, name, None
            end = body
        else:
            parameter, end = _parameter(content, body, number, name)
            yield number, name, parameter
        if end < len(content) and content[end] > _MOST_DESCRIPTION and (step == 0 or end < name_end + step):
            raise ValueError(f"the description of {name} has more than {_MOST_DESCRIPTION} characters")
        if step == 0:
            return
        at = name_end + step
        # Some programs leave the description out.
        described = end + 1 + content[end] if end < at else end
        if step < 0 or described > at or at >= len(content):
            raise ValueError(f"the parameter {name} states an impossible length")


def _parameter(content: bytes, at: int, group: int, name: str) -> tuple[_Parameter, int]:
    """Read the body of a parameter's record; return it, and where its description begins."""
    (kind,) = struct.unpack_from("b", content, at)
    dimensions = content[at + 1]
    if kind not in _WIDTHS or dimensions > _MOST_DIMENSIONS:
        raise ValueError(f"the parameter {name} has the type {kind} and {dimensions} dimensions")
    sizes = content[at + 2 : at + 2 + dimensions]
    begin = at + 2 + dimensions
    end = begin + _WIDTHS[kind] * math.prod(sizes)
    if len(sizes) < dimensions or end > len(content):
        raise ValueError(f"the parameter {name} is longer than the file")
    return _Parameter(group, name, kind, dimensions, content[begin:end]), end
