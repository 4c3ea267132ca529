"""ONNX networks of one convolution, written byte by byte."""

import struct
from pathlib import Path

import numpy as np


def write_onnx(path: Path, weights: np.ndarray, *, bias: tuple[float, ...], shape: tuple[int, ...], end: str) -> Path:
    """Write a network that mixes the channels of each pixel.

    Args:
        path: The file.
        weights: (channels out, channels in).
        bias: One per channel out.
        shape: Shape of the input.
        end: Name of the ONNX operator that follows: Sigmoid or Identity.
    """
    first = _text(1, "x") + _text(1, "w") + _text(1, "b") + _text(2, "y") + _text(4, "Conv") + _text(3, "mix")
    second = _text(1, "y") + _text(2, "z") + _text(4, end) + _text(3, "end")
    graph = _message(1, first) + _message(1, second) + _text(2, "graph")
    graph += _message(5, _tensor("w", weights[:, :, None, None])) + _message(5, _tensor("b", np.array(bias)))
    # Some programs list the weights among the inputs, and before the image.
    graph += _message(11, _value("w", (*weights.shape, 1, 1))) + _message(11, _value("x", shape))
    graph += _message(12, _value("z", (1, len(weights), *shape[2:])))
    path.write_bytes(_number(1, 8) + _message(7, graph) + _message(8, _text(1, "") + _number(2, 13)))
    return path


def _value(name: str, shape: tuple[int, ...]) -> bytes:
    sides = b"".join(_message(1, _number(1, side)) for side in shape)
    return _text(1, name) + _message(2, _message(1, _number(1, 1) + _message(2, sides)))


def _tensor(name: str, values: np.ndarray) -> bytes:
    sides = b"".join(_number(1, side) for side in values.shape)
    content = struct.pack(f"<{values.size}f", *values.ravel())
    return sides + _number(2, 1) + _text(8, name) + _message(9, content)


def _text(field: int, text: str) -> bytes:
    return _message(field, text.encode())


def _message(field: int, content: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _varint(value: int) -> bytes:
    content = b""
    while value > 127:
        content += bytes([value & 127 | 128])
        value >>= 7
    return content + bytes([value])
