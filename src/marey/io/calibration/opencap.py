"""Reading of calibrations of OpenCap: one pickle per camera, of which nothing is executed."""

import io
import pickletools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.io.calibration.parts import Faults, RawCamera, make_rig
from marey.io.documents import read_bytes

FILE_NAME = "cameraIntrinsicsExtrinsics.pickle"
"""Name of the calibration in the folder of each camera of a session."""
_KEYS = ("intrinsicMat", "distortion", "imageSize", "rotation", "translation")
"""Arrays of a calibration that are used."""
_REMEDY = (
    "It should be the file of an OpenCap session: a table of arrays intrinsicMat (3 x 3, px), distortion, imageSize "
    "(height, width), rotation (3 x 3, world to camera) and translation (mm)."
)
"""Remedy in the error messages."""
_LARGEST_PICKLE = 2**16
"""Size from which a file is not the calibration of one camera [bytes]. Chosen by hand: it has 2 kB."""
_ELEMENTS = {"f8": 8, "f4": 4, "i8": 8, "i4": 4, "i2": 2, "u1": 1, "u2": 2, "u4": 4, "u8": 8}
"""Allowed types of the elements of arrays, with their sizes [bytes]."""
_MOST_NUMBERS = 14
"""Largest number of values of an array of a calibration: the distortion coefficients of OpenCV."""
_MOST_CALLS = 200
"""Largest number of arrays, types and texts that a pickle makes, which bounds the memory. Chosen by hand: it has 10."""


def read_opencap(path: Path) -> Rig:
    """Read the cameras of an OpenCap session, or the pickles in one folder.

    The world is that of the checkerboard, in metres; the vertical axis depends on how it was placed.

    Args:
        path: A session, its folder `Videos`, a folder with pickles of cameras, or one of the files.

    Returns:
        The cameras, named like their folders (`Cam0`), or like the files if these are in one folder.

    Raises:
        FileProblem: There is no file, or a value is missing or wrong; the message lists everything.
    """
    files = camera_files(path)
    if not files:
        raise FileProblem(path, f"has no {FILE_NAME} of a camera", "Give the folder of an OpenCap session.")
    faults = Faults(path, _REMEDY)
    return make_rig(faults, [_camera(faults, name, file) for name, file in files.items()])


def camera_files(path: Path) -> dict[str, Path]:
    """Find the calibrations of the cameras of a session by their names.

    Args:
        path: As for `read_opencap`.
    """
    if path.is_file():
        if path.name != FILE_NAME and not _is_calibration(path):
            return {path.stem: path}
        path = path.parent.parent if path.name == FILE_NAME else path.parent
    places = [path / "Videos", path, *sorted(path.glob("VideoData/*"))]
    for place in places:
        found = {each.parent.name: each for each in sorted(place.glob(f"*/{FILE_NAME}")) if each.is_file()}
        if found:
            return found
    return {each.stem: each for each in sorted(path.glob("*.pickle")) if _is_calibration(each)}


def _is_calibration(path: Path) -> bool:
    """Return whether a pickle names the matrix of a camera; other programs leave pickles of other things."""
    try:
        with path.open("rb") as file:
            return b"intrinsicMat" in file.read(_LARGEST_PICKLE)
    except OSError:
        return False


def _camera(faults: Faults, name: str, path: Path) -> Camera | None:
    content = read_pickle(path, _REMEDY, largest=_LARGEST_PICKLE)
    if not isinstance(content, Mapping):
        raise FileProblem(path, "is not a table of arrays", _REMEDY)
    given = {key: content.get(key) for key in _KEYS}
    flat: dict[str, Floats] = {
        key: np.asarray(value, float)
        for key, value in given.items()
        if isinstance(value, np.ndarray) and 0 < value.size <= _MOST_NUMBERS
    }
    if len(flat) < len(_KEYS):
        faults.add(name, [f"has no array {key}" for key in _KEYS if key not in flat])
        return None
    raw = RawCamera(
        name=name, size=flat["imageSize"].ravel()[::-1], matrix=flat["intrinsicMat"],
        distortion=flat["distortion"].ravel(), rotation=flat["rotation"],
        translation=flat["translation"].ravel() / 1000,
    )  # fmt: skip
    return raw.checked(faults)


@dataclass
class _Array:
    """An array of NumPy in the making, from the state that a pickle gives it."""

    value: np.ndarray | None = None


@dataclass
class _Type:
    """The type of the elements of an array."""

    code: str
    order: str = "<"

    def element(self) -> np.dtype[Any]:
        if self.code not in _ELEMENTS:
            raise _Refused(f"has an array of the type '{self.code}'")
        return np.dtype(("<" if self.order == "|" else self.order) + self.code)


class _Refused(Exception):
    """What a pickle contains that is not allowed, as the predicate of a sentence."""


_MARK = object()
"""Begin of a group of values on the stack of a pickle."""


def read_pickle(path: Path, remedy: str, *, largest: int = _LARGEST_PICKLE) -> object:
    """Read tables, lists, texts, numbers and arrays of numbers from a pickle, without executing anything.

    The instructions of the pickle are interpreted here; of the functions that it may name, only those that make arrays
    of NumPy are known, and they are not called either.

    Args:
        path: The file.
        remedy: Description of a correct file, as a sentence.
        largest: Largest size of the file [bytes].

    Returns:
        The content.

    Raises:
        FileProblem: The file cannot be read, is too large, or contains anything else.
    """
    content = read_bytes(path, remedy)
    if len(content) > largest:
        raise FileProblem(path, f"has {len(content)} bytes; at most {largest} are expected", remedy)
    try:
        return _Machine().run(content)
    except _Refused as refused:
        raise FileProblem(path, str(refused), remedy) from refused
    except (ValueError, TypeError, KeyError, IndexError, OverflowError, AttributeError, RecursionError) as error:
        raise FileProblem(path, f"is not a pickle of a calibration, or damaged ({error})", remedy) from error


@dataclass
class _Machine:
    """Interprets the instructions of a pickle, of which only those for plain values are known."""

    stack: list[Any] = field(default_factory=list)
    memory: dict[int, Any] = field(default_factory=dict)
    calls: int = 0

    def run(self, content: bytes) -> object:
        for code, argument, _ in pickletools.genops(io.BytesIO(content)):
            if code.name in ("PROTO", "FRAME"):
                continue
            if code.name == "STOP":
                return _finished(self.stack.pop())
            if code.name in _CONSTANTS:
                self.stack.append(_CONSTANTS[code.name])
            elif code.name in _VALUES:
                self.stack.append(argument)
            elif code.name in _INSTRUCTIONS:
                _INSTRUCTIONS[code.name](self, argument)
            else:
                raise _Refused(f"contains the instruction {code.name}, which a calibration does not need")
        raise ValueError("it has no end")

    def group(self) -> list[Any]:
        """Remove and return the values above the last mark."""
        items: list[Any] = []
        while (item := self.stack.pop()) is not _MARK:
            items.append(item)
        return items[::-1]

    def tuple(self, count: int) -> None:
        items = [self.stack.pop() for _ in range(count)][::-1]
        self.stack.append(tuple(items))

    def remember(self, place: int | None) -> None:
        self.memory[len(self.memory) if place is None else place] = self.stack[-1]

    def named(self, module: str, name: str) -> None:
        if (module.replace("numpy._core", "numpy.core"), name) in _NAMES:
            self.stack.append((_NAMED, name))
            return
        raise _Refused(f"names {module}.{name}"[:100] + ", which is not executed")

    def call(self) -> None:
        arguments, function = self.stack.pop(), self.stack.pop()
        if not isinstance(function, tuple) or function[0] is not _NAMED or not isinstance(arguments, tuple):
            raise ValueError("it calls what is no function")
        self.calls += 1
        if self.calls > _MOST_CALLS:
            raise _Refused(f"makes more than {_MOST_CALLS} values")
        if function[1] == "_reconstruct":
            self.stack.append(_Array())
        elif function[1] == "dtype":
            self.stack.append(_Type(code=str(arguments[0])))
        elif function[1] == "encode" and arguments[1:] in (("latin1",), ("latin-1",)):
            self.stack.append(str(arguments[0]).encode("latin-1"))
        elif function[1] == "_frombuffer":
            data, kind, shape, order = arguments
            self.stack.append(_Array(_array((1, shape, kind, order == "F", bytes(data)))))
        elif function[1] == "scalar":
            self.stack.append(float(np.frombuffer(arguments[1], arguments[0].element())[0]))
        else:
            raise _Refused(f"calls {function[1]}, which is not executed")

    def build(self) -> None:
        state, target = self.stack.pop(), self.stack[-1]
        if isinstance(target, _Type):
            target.order = {">": ">", "<": "<", "|": "|"}[state[1]]
        elif isinstance(target, _Array):
            target.value = _array(state)
        else:
            raise _Refused("sets the state of an object, which a calibration does not need")


_NAMED = object()
"""Mark of a function that a pickle names."""
_NAMES = (
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy.core.numeric", "_frombuffer"),
    ("_codecs", "encode"),
)
"""Functions that occur in pickles of arrays."""
_CONSTANTS: Mapping[str, Any] = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
"""Instructions that push a constant."""
_VALUES = frozenset(
    (
        *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "FLOAT", "BINFLOAT"),
        *("STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8"),
        *("BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"),
    )
)
"""Instructions that push their argument."""


def _append(machine: _Machine, items: list[Any]) -> None:
    machine.stack[-1].extend(items) if isinstance(machine.stack[-1], list) else _fail("it appends to no list")


def _set(machine: _Machine, items: list[Any]) -> None:
    table = machine.stack[-1]
    pairs = dict(zip(items[::2], items[1::2], strict=True))
    table.update(pairs) if isinstance(table, dict) else _fail("it sets keys of no table")


def _fail(text: str) -> None:
    raise ValueError(text)


def _table(items: list[Any]) -> dict[Any, Any]:
    return dict(zip(items[::2], items[1::2], strict=True))


_INSTRUCTIONS: Mapping[str, Callable[[_Machine, Any], None]] = {
    "MARK": lambda machine, _: machine.stack.append(_MARK),
    "POP": lambda machine, _: _discard(machine.stack.pop()),
    "POP_MARK": lambda machine, _: _discard(machine.group()),
    "DUP": lambda machine, _: machine.stack.append(machine.stack[-1]),
    "EMPTY_DICT": lambda machine, _: machine.stack.append({}),
    "EMPTY_LIST": lambda machine, _: machine.stack.append([]),
    "EMPTY_TUPLE": lambda machine, _: machine.stack.append(()),
    "DICT": lambda machine, _: machine.stack.append(_table(machine.group())),
    "LIST": lambda machine, _: machine.stack.append(machine.group()),
    "TUPLE": lambda machine, _: machine.stack.append(tuple(machine.group())),
    "TUPLE1": lambda machine, _: machine.tuple(1),
    "TUPLE2": lambda machine, _: machine.tuple(2),
    "TUPLE3": lambda machine, _: machine.tuple(3),
    "APPEND": lambda machine, _: _append(machine, [machine.stack.pop()]),
    "APPENDS": lambda machine, _: _append(machine, machine.group()),
    "SETITEM": lambda machine, _: _set(machine, [machine.stack.pop(), machine.stack.pop()][::-1]),
    "SETITEMS": lambda machine, _: _set(machine, machine.group()),
    "MEMOIZE": lambda machine, _: machine.remember(None),
    "PUT": lambda machine, place: machine.remember(place),
    "BINPUT": lambda machine, place: machine.remember(place),
    "LONG_BINPUT": lambda machine, place: machine.remember(place),
    "GET": lambda machine, place: machine.stack.append(machine.memory[place]),
    "BINGET": lambda machine, place: machine.stack.append(machine.memory[place]),
    "LONG_BINGET": lambda machine, place: machine.stack.append(machine.memory[place]),
    "GLOBAL": lambda machine, argument: machine.named(*str(argument).split(" ", 1)),
    "STACK_GLOBAL": lambda machine, _: machine.named(*[str(machine.stack.pop()) for _ in range(2)][::-1]),
    "REDUCE": lambda machine, _: machine.call(),
    "BUILD": lambda machine, _: machine.build(),
}
"""Instructions of pickles for plain values, and what they do."""


def _discard(_: object) -> None:
    """Forget a value."""


def _array(state: Any) -> np.ndarray:
    """Make an array from the state that NumPy pickles: version, shape, type, order of the axes, bytes."""
    _, shape, kind, columns_first, data = state
    element = kind.element()
    if isinstance(data, str):
        data = data.encode("latin-1")
    if len(shape) > 4 or any(not 0 <= side <= len(data) for side in shape):
        raise _Refused(f"has an array of the shape {shape}")
    return np.frombuffer(data, element).reshape(shape, order="F" if columns_first else "C")


def _finished(value: Any) -> Any:
    """Replace arrays in the making in the outermost table."""
    if not isinstance(value, dict):
        return value
    return {key: item.value if isinstance(item, _Array) else item for key, item in value.items()}
