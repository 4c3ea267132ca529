"""Reading glTF 2.0 files of other programs, and adding arrays to a copy of one."""

import base64
import json
import struct
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.geometry import rotations
from marey.io.atomic import replacing
from marey.io.gltf.structure import COMPONENT, WIDTH, array_fits, document_fault

_EXPORT_AGAIN = "Export the character again."
"""Remedy for a damaged file."""
_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
"""First four bytes of a GLB ("glTF"), and the types of its chunks ("JSON", "BIN"), by the glTF 2.0 specification."""


class Gltf:
    """A GLB or glTF file in memory: the unchanged document and its buffers.

    Args:
        path: The file.

    Raises:
        FileProblem: The file is not glTF 2.0.
    """

    def __init__(self, path: Path | str):
        self.path = Path(path)
        self.chunks: list[tuple[int, bytes]] | None = None
        """The chunks of a GLB after the document, each with its type; None for a glTF."""
        try:
            data = self.path.read_bytes()
            text = self._unpack(data) if data[:4] == b"glTF" else data
            self.document: dict[str, Any] = json.loads(text)
            version = str(self.document["asset"]["version"])
        except (OSError, ValueError, KeyError, TypeError, RecursionError, struct.error) as error:
            wrong = f"is not a GLB or glTF file of version 2 ({error})"
            raise FileProblem(path, wrong, "Export the character as binary glTF 2.0 (.glb).") from error
        if not version.startswith("2"):
            raise FileProblem(path, f"is glTF {version}", "Export the character as glTF 2.0.")
        if (fault := document_fault(self.document)) is not None:
            raise FileProblem(path, fault, _EXPORT_AGAIN)
        self.nodes: list[dict[str, Any]] = self.document.get("nodes", [])
        self._buffers: dict[int, bytes] = {}

    def _unpack(self, data: bytes) -> bytes:
        magic, version, length = struct.unpack_from("<III", data)
        if magic != _MAGIC or version != 2 or length > len(data):
            raise ValueError("it has another version or is truncated")
        at, parts = 12, []
        while at + 8 <= length:
            size, kind = struct.unpack_from("<II", data, at)
            parts.append((kind, data[at + 8 : at + 8 + size]))
            at += 8 + size
        if not parts or parts[0][0] != _JSON:
            raise ValueError("its first chunk is not JSON")
        self.chunks = parts[1:]
        return parts[0][1]

    def buffer(self, number: int) -> bytes:
        """Return the bytes of a buffer.

        Raises:
            FileProblem: The buffer cannot be read.
        """
        if number not in self._buffers:
            self._buffers[number] = self._read_buffer(number)
        return self._buffers[number]

    def _read_buffer(self, number: int) -> bytes:
        uri = self.document["buffers"][number].get("uri")
        if uri is None:
            inside = [part for kind, part in self.chunks or [] if kind == _BIN]
            if number or not inside:
                raise FileProblem(self.path, f"lacks the data of its buffer {number}", _EXPORT_AGAIN)
            return inside[0]
        if str(uri).startswith("data:"):
            return base64.b64decode(uri.partition(",")[2])
        name = PurePosixPath(unquote(str(uri)))
        if name.is_absolute() or ".." in name.parts or "\\" in str(name) or ":" in str(name):
            raise FileProblem(self.path, f"refers to {str(name)[:80]!r}, outside its folder", _EXPORT_AGAIN)
        other = self.path.parent / name
        try:
            return other.read_bytes()
        except OSError as error:
            wrong = f"refers to {other.name}, which cannot be read"
            raise FileProblem(self.path, wrong, "Put that file into the same folder.") from error

    def array(self, index: int) -> np.ndarray:
        """Return the array (n, width) of one accessor, as float64 or integers.

        Raises:
            FileProblem: The array is compressed or sparse.
        """
        accessor = self.document["accessors"][index]
        if "bufferView" not in accessor or "sparse" in accessor:
            remedy = "Export the character without compression."
            raise FileProblem(self.path, "has compressed or sparse arrays, which are not supported", remedy)
        view = self.document["bufferViews"][accessor["bufferView"]]
        kind = {number: name for name, number in COMPONENT.items()}[accessor["componentType"]]
        width = WIDTH[accessor["type"]]
        size = np.dtype(kind).itemsize
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        stride = view.get("byteStride", width * size)
        held = self.buffer(view["buffer"])
        if not array_fits(accessor["count"], width, kind, start, stride, len(held)):
            raise FileProblem(self.path, f"has an array {index} that is longer than its buffer", _EXPORT_AGAIN)
        rows = np.ndarray((accessor["count"], width), kind, held, start, (stride, size))
        scale = float(np.iinfo(kind).max) if accessor.get("normalized") else 1.0
        return rows / scale if accessor.get("normalized") else rows.astype(float if kind == "<f4" else np.int64)

    def parents(self) -> dict[int, int]:
        """Return the parent of each node; roots have none."""
        return {child: n for n, node in enumerate(self.nodes) for child in node.get("children", [])}

    def world_from_nodes(self) -> Floats:
        """Return the matrix of each node (n, 4, 4), scene from node, in the pose of the file."""
        local = np.stack([local_matrix(node) for node in self.nodes])
        world, parent = np.array(local), self.parents()
        for n in range(len(self.nodes)):
            up = parent.get(n)
            while up is not None:
                world[n] = local[up] @ world[n]
                up = parent.get(up)
        return world

    def name(self, node: int) -> str:
        """Return the name of a node, or its index if it has no name."""
        return str(self.nodes[node].get("name", f"node {node}"))

    def skinned(self) -> list[tuple[int, int]]:
        """Return the indices of mesh and skin of each skinned mesh.

        Raises:
            FileProblem: The file has no skinned mesh.
        """
        found = [(node["mesh"], node["skin"]) for node in self.nodes if "mesh" in node and "skin" in node]
        if not found:
            raise FileProblem(self.path, "has no skinned mesh", "Export the character with its armature and skin.")
        return found


def local_matrix(node: Mapping[str, Any]) -> Floats:
    """Return the matrix of a node (4, 4), parent from node."""
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    matrix[:3, :3] = rotations.from_quaternion(np.array([w, x, y, z], float)) * np.array(node.get("scale", (1, 1, 1)))
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def pack_glb(document: Mapping[str, Any], chunks: list[tuple[int, bytes]]) -> bytes:
    """Return the bytes of a GLB with a document and further chunks."""
    text = json.dumps(document, separators=(",", ":"), ensure_ascii=False).encode()
    parts = [
        (_JSON, text + b" " * (-len(text) % 4)),
        *((kind, data + b"\0" * (-len(data) % 4)) for kind, data in chunks),
    ]
    body = b"".join(struct.pack("<II", len(data), kind) + data for kind, data in parts)
    return struct.pack("<III", _MAGIC, 2, 12 + len(body)) + body


def binary_chunk(data: bytes) -> tuple[int, bytes]:
    """Return the chunk of a GLB that holds its first buffer."""
    return _BIN, data


class GltfAdditions:
    """A copy of a glTF file to which arrays are appended; nothing else changes.

    Args:
        gltf: The file; its document is copied.
    """

    def __init__(self, gltf: Gltf):
        self.gltf = gltf
        self.document: dict[str, Any] = json.loads(json.dumps(gltf.document))
        self.data = bytearray()
        buffers = self.document.setdefault("buffers", [])
        # The embedded buffer of a GLB is the first one and has no URI; other files get a new buffer.
        self._inside = gltf.chunks is not None and bool(buffers) and "uri" not in buffers[0]
        if gltf.chunks is not None and not buffers:
            self._inside = True
            buffers.append({"byteLength": 0})
        self._start = len(gltf.buffer(0)) if self._inside and buffers[0]["byteLength"] else 0
        self._start += -self._start % 4
        self.number = 0 if self._inside else len(buffers)

    def add(self, array: np.ndarray, shape: str, *, bounds: bool = False) -> int:
        """Append an array in single precision and return the index of its accessor.

        Args:
            array: (n, width).
            shape: Type of a row in glTF (`SCALAR`, `VEC3`, ...).
            bounds: Whether to store the minimum and maximum of each column.
        """
        data = np.ascontiguousarray(array, dtype="<f4").reshape(len(array), -1)
        views, accessors = (self.document.setdefault(key, []) for key in ("bufferViews", "accessors"))
        views.append({"buffer": self.number, "byteOffset": self._start + len(self.data), "byteLength": data.nbytes})
        self.data += data.tobytes()
        accessor = {
            "bufferView": len(views) - 1, "componentType": COMPONENT["<f4"], "count": len(data), "type": shape,
        }  # fmt: skip
        if bounds:
            accessor |= {"min": data.min(0).tolist(), "max": data.max(0).tolist()}
        accessors.append(accessor)
        return len(accessors) - 1

    def write(self, path: Path | str) -> None:
        """Write the copy as GLB or glTF, as the original."""
        chunks, buffers = list(self.gltf.chunks or []), self.document["buffers"]
        if self._inside:
            old = self.gltf.buffer(0) if self._start else b""
            whole = old + b"\0" * (self._start - len(old)) + bytes(self.data)
            buffers[0]["byteLength"] = len(whole)
            chunks = [binary_chunk(whole), *(c for c in chunks if c[0] != _BIN)]
        else:
            uri = "data:application/octet-stream;base64," + base64.b64encode(bytes(self.data)).decode()
            buffers.append({"byteLength": len(self.data), "uri": uri})
        if self.gltf.chunks is None:
            written = json.dumps(self.document, ensure_ascii=False).encode()
        else:
            written = pack_glb(self.document, chunks)
        with replacing(path) as temporary:
            temporary.write_bytes(written)
