"""Networks that find the person in an image, in TFLite and ONNX files, run by OpenCV.

OpenCV reads the layers of a network, but does not return the size of its input. It is read here from the file: from the
FlatBuffers tables of a TFLite model (github.com/tensorflow/tensorflow, lite/schema/schema.fbs), and from the protocol
buffer of an ONNX model (github.com/onnx/onnx, onnx/onnx.proto).
"""

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from marey.arrays import Floats, Image
from marey.errors import FileProblem

TOLERANCE = 1e-3
"""Largest excess of a probability over 0 and 1, which is rounding. Chosen by hand."""
ASSUMED_SIZE = 256
"""Width and height of the input where the file leaves them open, as for fully convolutional networks [px]. Chosen by
hand."""
_REMEDY = (
    "It should be a TFLite or ONNX network with one RGB image (values from 0 to 1) as input, and as output the "
    "probability of a person, or two channels whose second one is the person."
)
"""Remedy in the error messages."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PersonNetwork:
    """A network that gives the probability of a person at each pixel of an image."""

    path: Path
    size: tuple[int, int]
    """Width and height of its input [px]."""
    channels_last: bool
    """Whether OpenCV needs the input's channels after its rows and columns."""

    def loaded(self) -> Callable[[Image], Image]:
        """Load the network.

        Returns:
            A function from an image (h, w, 3) or (h, w, 1) uint8 of any size, blue first, to the probability of a
            person (h, w) uint8, from 0 to 255. It raises FileProblem if the output has an unexpected shape or is no
            probability. It is used by one thread at a time.
        """
        net = _loaded(self.path)

        def levels(image: Image) -> Image:
            height, width = image.shape[:2]
            large = cv2.resize(self.probability(net, image), (width, height), interpolation=cv2.INTER_LINEAR)
            return np.asarray(np.rint(255.0 * large), np.uint8)

        return levels

    def probability(self, net: cv2.dnn.Net, image: Image) -> Floats:
        """Return the probability of a person, at the resolution of the output.

        Args:
            net: The network as OpenCV loads it.
            image: (h, w, C) uint8, blue first.

        Returns:
            (rows, columns) float32.

        Raises:
            FileProblem: The output has an unexpected shape, or is no probability.
        """
        colours = image if image.shape[2] == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
        small = cv2.resize(colours, self.size, interpolation=cv2.INTER_AREA)
        blob = cv2.dnn.blobFromImage(small, 1 / 255, self.size, swapRB=True)
        if self.channels_last:
            blob = np.ascontiguousarray(blob.transpose(0, 2, 3, 1))
        try:
            with _quiet():
                net.setInput(blob)
                output = np.asarray(net.forward(), np.float32)
        except cv2.error as error:
            width, height = self.size
            wrong = f"cannot be run on an image of {width} x {height} ({_reason(error)})"
            raise FileProblem(self.path, wrong, _REMEDY) from error
        return _person_channel(self.path, output)


def open_person_network(path: Path) -> PersonNetwork:
    """Open a network that segments people, and try it on an image.

    Args:
        path: The file, TFLite or ONNX.

    Returns:
        The network.

    Raises:
        FileProblem: The file does not exist or is no such network, or its input or output has an unexpected shape.
    """
    if not path.is_file():
        wrong = "is not a file" if path.exists() else "does not exist"
        raise FileProblem(path, wrong, "Correct the network (--person-net, or [masks] network in trial.toml).")
    net = _loaded(path)
    content = path.read_bytes()
    try:
        shape = _tflite_input(content) if path.suffix.lower() == ".tflite" else _onnx_input(content)
    except (IndexError, ValueError, struct.error) as error:
        raise FileProblem(path, "does not state the shape of its input", _REMEDY) from error
    last = len(shape) == 4 and shape[3] == 3
    if len(shape) != 4 or not (last or shape[1] == 3) or shape[0] > 1:
        raise FileProblem(path, f"has an input of the shape {list(shape)}", _REMEDY)
    height, width = (n if n > 0 else ASSUMED_SIZE for n in (shape[1:3] if last else shape[2:4]))
    # OpenCV converts TFLite models to channels first.
    network = PersonNetwork(
        path=path, size=(width, height), channels_last=last and path.suffix.lower() != ".tflite"
    )  # fmt: skip
    network.probability(net, np.full((height, width, 3), 128, np.uint8))
    return network


def _loaded(path: Path) -> cv2.dnn.Net:
    suffix = path.suffix.lower()
    if suffix not in (".tflite", ".onnx"):
        raise FileProblem(path, f"has the extension '{path.suffix}', which is neither .tflite nor .onnx", _REMEDY)
    if suffix == ".onnx":
        _require_operators(path)
    try:
        with _quiet():
            net = cv2.dnn.readNetFromTFLite(str(path)) if suffix == ".tflite" else cv2.dnn.readNetFromONNX(str(path))
    except cv2.error as error:
        raise FileProblem(path, f"is no network that OpenCV can read ({_reason(error)})", _REMEDY) from error
    if net.empty():
        raise FileProblem(path, "is no network that OpenCV can read", _REMEDY)
    return net


_TEXTS_OF_A_NODE = (1, 2, 3, 4, 7)
"""Fields of an operator in ONNX that are texts: inputs, outputs, name, type and domain (onnx.proto, NodeProto)."""


def _require_operators(path: Path) -> None:
    """Check the texts of an ONNX network's operators: OpenCV ends the program where it cannot print an unknown one."""
    try:
        nodes = list(_messages(next(_messages(path.read_bytes(), 7)), 1))
        texts = [text for node in nodes for key, text in _fields(node) if key in _TEXTS_OF_A_NODE]
    except (IndexError, ValueError):  # OpenCV reports that it is no network
        return
    try:
        for text in texts:
            if isinstance(text, bytes):
                text.decode("utf-8")
    except UnicodeDecodeError as error:
        raise FileProblem(path, "has an operator whose name or inputs are damaged", _REMEDY) from error


def _reason(error: cv2.error) -> str:
    """Return OpenCV's description of an error in one line."""
    return " ".join(str(getattr(error, "err", "") or error).split())[:160]


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep OpenCV from printing what is raised as an error anyway."""
    before = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(before)


def _person_channel(path: Path, output: Floats) -> Floats:
    """Return the probability of a person (rows, columns) from a network's output."""
    planes = output[0] if output.ndim == 4 and len(output) == 1 else output
    if planes.ndim == 2:
        planes = planes[None]
    if planes.ndim == 3 and planes.shape[0] > 2 and planes.shape[2] <= 2:
        planes = planes.transpose(2, 0, 1)
    if planes.ndim != 3 or len(planes) not in (1, 2) or min(planes.shape[1:]) < 2:
        raise FileProblem(path, f"has an output of the shape {list(output.shape)}", _REMEDY)
    if len(planes) == 2:
        shares = planes.min() >= -TOLERANCE and np.allclose(planes.sum(0), 1.0, atol=10 * TOLERANCE)
        person = planes[1] if shares else 1 / (1 + np.exp(np.clip(planes[0] - planes[1], -50, 50)))
    else:
        person = planes[0]
    low, high = float(np.min(person)), float(np.max(person))
    if not (low >= -TOLERANCE and high <= 1 + TOLERANCE):
        raise FileProblem(path, f"gives values from {low:.3g} to {high:.3g}, which are no probabilities", _REMEDY)
    return np.ascontiguousarray(np.clip(person, 0, 1), np.float32)


def _tflite_input(content: bytes) -> tuple[int, ...]:
    """Return the shape of the first input of a TFLite model."""

    def number(place: int, kind: str = "<I") -> int:
        return int(struct.unpack_from(kind, content, place)[0])

    def field(table: int, index: int) -> int:
        """Return where a table stores the offset of one of its fields, and follow it."""
        entries = table - number(table, "<i")
        offset = number(entries + 4 + 2 * index, "<H") if 4 + 2 * index < number(entries, "<H") else 0
        if offset == 0:
            raise ValueError("a field is missing")
        return table + offset + number(table + offset)

    def element(vector: int, index: int) -> int:
        """Return a table in a vector of tables."""
        place = vector + 4 + 4 * index
        return place + number(place)

    graph = element(field(number(0), 2), 0)
    tensors, inputs = field(graph, 0), field(graph, 1)
    shape = field(element(tensors, number(inputs + 4)), 0)
    return tuple(number(shape + 4 + 4 * i, "<i") for i in range(number(shape)))


def _onnx_input(content: bytes) -> tuple[int, ...]:
    """Return the shape of the first input of an ONNX model that is no weight; 0 where it is open."""
    graph = next(_messages(content, 7))
    weights = {name for tensor in _messages(graph, 5) for name in _messages(tensor, 8)}
    for given in _messages(graph, 11):
        if next(_messages(given, 1)) not in weights:
            tensor = next(_messages(next(_messages(given, 2)), 1))
            sides = _messages(next(_messages(tensor, 2)), 1)
            return tuple(next((n for key, n in _fields(side) if key == 1 and isinstance(n, int)), 0) for side in sides)
    raise ValueError("there is no input")


def _messages(content: bytes, wanted: int) -> Iterator[bytes]:
    """Iterate over the values of one field of a protocol buffer that are messages or texts."""
    found = [value for key, value in _fields(content) if key == wanted and isinstance(value, bytes)]
    if not found and wanted in (1, 2, 7):
        raise ValueError("a field is missing")
    return iter(found)


def _fields(content: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Iterate over the fields of a protocol buffer: number, and value or content."""
    place = 0
    while place < len(content):
        tag, place = _varint(content, place)
        kind = tag & 7
        if kind == 0:
            value, place = _varint(content, place)
            yield tag >> 3, value
            continue
        if kind == 2:
            size, place = _varint(content, place)
        elif kind in (1, 5):
            size = 8 if kind == 1 else 4
        else:
            raise ValueError("it is no protocol buffer")
        yield tag >> 3, content[place : place + size]
        place += size


def _varint(content: bytes, place: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = content[place]
        value |= (byte & 127) << shift
        place, shift = place + 1, shift + 7
        if byte < 128:
            return value, place
