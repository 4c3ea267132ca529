"""Files that are damaged in one place: their bytes, the values of a JSON tree, or the arrays of an NPZ."""

import io
import json
import re
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

NUMBERS = (b"nan", b"inf", b"-1e400", b"1e30", b"-1", b"0", b"1e-320", b"9" * 5000, b"", b"x", b"true", b"[1, 2]")
TEXTS = (b"\x00", b"\xff\xfe", b"[" * 3000, b"{" * 3000, b"<a>" * 3000, b"'", b'"', b"&x;", b"../x", b"\n" * 50)
VALUES = (None, True, -1, 0, 10**400, 1e308, 0.5, "", "x", "../x", [], {}, [[]], [1, "x"], float("nan"), float("inf"))


def damaged_bytes(content: bytes, rng: np.random.Generator) -> bytes:
    """Change a file in one place: a number, some bytes, a part that is missing or is there twice."""
    tokens = [match.span() for match in re.finditer(rb"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?", content)]
    how = rng.integers(6)
    at, end = sorted(rng.integers(len(content) + 1, size=2).tolist())
    if how == 0 and tokens:
        first, last = tokens[rng.integers(len(tokens))]
        return content[:first] + NUMBERS[rng.integers(len(NUMBERS))] + content[last:]
    if how == 1:
        return content[:at] + TEXTS[rng.integers(len(TEXTS))] + content[at:]
    if how == 2:
        return content[:at]
    if how == 3:
        return content[:at] + content[end:]
    if how == 4:
        return content[:at] + content[at:end] * 2 + content[end:]
    changed = bytearray(content)
    for place in rng.integers(max(len(content), 1), size=3 if content else 0):
        changed[place] = rng.integers(256)
    return bytes(changed)


def damaged_glb(content: bytes, rng: np.random.Generator) -> bytes:
    """Replace or remove one value of the document of a GLB."""
    length = struct.unpack_from("<I", content, 12)[0]
    text = damaged_json(content[20 : 20 + length], rng)
    text += b" " * (-len(text) % 4)
    rest = content[20 + length :]
    return content[:8] + struct.pack("<III", 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


def damaged_json(content: bytes, rng: np.random.Generator) -> bytes:
    """Replace or remove one value of a JSON file."""
    tree = json.loads(content)
    node: dict | list = tree
    while True:
        keys = list(node) if isinstance(node, dict) else list(range(len(node)))
        if not keys:
            break
        key = keys[rng.integers(len(keys))]
        inner = node[key]
        if isinstance(inner, dict | list) and len(inner) and rng.integers(3):
            node = inner
            continue
        if rng.integers(4):
            node[key] = VALUES[rng.integers(len(VALUES))]
        else:
            del node[key]
        break
    return json.dumps(tree).encode()


def damaged_npz(content: bytes, rng: np.random.Generator) -> bytes:
    """Replace or remove one array of an NPZ."""
    with np.load(io.BytesIO(content)) as file:
        arrays = {name: file[name] for name in file.files}
    name = list(arrays)[rng.integers(len(arrays))]
    own = arrays[name]
    changes: tuple[Callable[[], np.ndarray | None], ...] = (
        lambda: None,
        lambda: own[..., None],
        lambda: own[:0] if own.ndim else own.reshape(1, 1),
        lambda: own.ravel()[: max(own.size - 1, 0)],
        lambda: own.astype(str),
        lambda: np.zeros(own.shape, complex),
        lambda: np.zeros(own.shape, "M8[s]"),
        lambda: np.full(own.shape, 10**18),
        lambda: np.full(own.shape, -1),
        lambda: np.full(own.shape, np.nan),
        lambda: np.full(own.shape, 1e300),
        lambda: np.array("x"),
        lambda: np.zeros(own.shape, bool),
        lambda: own.T,
    )
    changed = changes[rng.integers(len(changes))]()
    if changed is None:
        del arrays[name]
    else:
        arrays[name] = changed
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def damaged(path: Path, content: bytes, rng: np.random.Generator) -> bytes:
    """Damage a file in a way that suits its format in half of the cases, and byte by byte in the others."""
    if rng.integers(2):
        if path.suffix == ".json":
            return damaged_json(content, rng)
        if path.suffix == ".glb":
            return damaged_glb(content, rng)
        if path.suffix == ".npz":
            return damaged_npz(content, rng)
    return damaged_bytes(content, rng)
