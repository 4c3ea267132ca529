"""Reading and writing of triangle meshes of bones and cartilage: PLY, STL, VTK, GLB, and NPZ."""

import struct
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats, Image
from marey.errors import FileProblem, MareyError
from marey.io.atomic import replacing
from marey.io.npz import read_arrays
from marey.knee.space.surface import TriangleSurface

ENDINGS = (".ply", ".stl", ".vtk", ".glb")
"""File name extensions of the formats that are written; OBJ, OFF and NPZ can also be read."""
_READ = (*ENDINGS, ".obj", ".off", ".npz")
"""File name extensions of the formats that are read."""
GLTF_FROM_LPS = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]) / 1000
"""(3, 3) Transform to glTF (metres; x left, y up, z front) from LPS (millimetres; x left, y back, z head)."""


def read_mesh(path: Path | str) -> TriangleSurface:
    """Read a surface in LPS [mm]; faces are flipped if all point inward, and coincident corners of STL are merged.

    Args:
        path: PLY, STL, VTK (legacy polygons), GLB (converted back to LPS millimetres), OBJ, OFF, or NPZ with
            `vertices` and `faces`. The order of the vertices is kept, except for STL, which has none.

    Raises:
        FileProblem: The file is missing or damaged, has another format, or contains no triangles.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in _READ:
        raise FileProblem(path, "has an unknown mesh format", f"The known formats are {', '.join(_READ)}.")
    if not path.is_file():
        raise FileProblem(path, "does not exist", "Check its name.")
    if not path.stat().st_size:
        raise FileProblem(path, "is empty", "Copy or write it again.")
    if ending == ".npz":
        arrays = read_arrays(path, ("vertices", "faces"), texts=())
        vertices, faces = arrays["vertices"], arrays["faces"]
    elif ending == ".vtk":
        vertices, faces = _read_vtk(path)
    else:
        vertices, faces = _read_with_trimesh(path)
    _require_triangles(path, vertices, faces)
    if ending == ".glb":
        vertices = vertices @ np.linalg.inv(GLTF_FROM_LPS).T
    if ending == ".stl" and len(vertices):
        vertices, place = np.unique(vertices, axis=0, return_inverse=True)
        faces = place.reshape(-1)[faces]
    return _outward(_checked(path, vertices, faces))


def write_mesh(
    path: Path | str,
    surface: TriangleSurface,
    *,
    colours: Image | None = None,
    values: Mapping[str, Floats] | None = None,
) -> None:
    """Write a surface in the format given by the file name extension.

    Args:
        path: `.ply`, `.stl`, `.vtk` (legacy, binary) or `.glb` (metres, Y up).
        surface: The mesh.
        colours: (V, 3) red, green and blue of each vertex, from 0 to 255; not stored in STL.
        values: Named values (V,) at the vertices, such as `thickness_mm`; stored in PLY and VTK only.

    Raises:
        FileProblem: The extension is unknown, or the folder cannot be written to.
    """
    path = Path(path)
    writers = {".ply": _ply, ".stl": _stl, ".vtk": _vtk, ".glb": _glb}
    if path.suffix.lower() not in writers:
        raise FileProblem(path, "has an unknown mesh format", f"The formats for writing are {', '.join(ENDINGS)}.")
    data = writers[path.suffix.lower()](surface, colours, values or {})
    with replacing(path) as beside:
        beside.write_bytes(data)


def _require_triangles(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Require arrays (V, 3) and (T, 3) that are not empty."""
    if not all(values.ndim == 2 and values.shape[1] == 3 and len(values) for values in (vertices, faces)):
        raise FileProblem(path, "contains no triangles", "Give a surface, not points or lines.")


def _checked(path: Path, vertices: np.ndarray, faces: np.ndarray) -> TriangleSurface:
    if faces.dtype.kind not in "fiu" or not np.isfinite(faces).all() or (faces != np.round(faces)).any():
        raise FileProblem(path, "has faces that are not whole numbers", "Write it again.")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise FileProblem(path, "has faces with vertices that do not exist", "Write it again.")
    faces = faces.astype(np.int64)
    if not np.isfinite(vertices[np.unique(faces)]).all():
        raise FileProblem(path, "has vertices that are not finite", "Write it again.")
    return TriangleSurface(vertices_mm=vertices, faces=faces)


def _outward(surface: TriangleSurface) -> TriangleSurface:
    """Flip the faces if the enclosed volume is negative; computed about the centroid, as the surface may be open."""
    middle = surface.vertices_mm.mean(0)
    if TriangleSurface(vertices_mm=surface.vertices_mm - middle, faces=surface.faces).volume_mm3 >= 0:
        return surface
    return TriangleSurface(vertices_mm=surface.vertices_mm, faces=surface.faces[:, ::-1])


def _read_with_trimesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            mesh: Any = trimesh.load(path, process=False, force="mesh")
        return np.array(mesh.vertices, float), np.array(mesh.faces, np.int64)
    except MemoryError:
        raise
    except Exception as error:  # the readers raise errors of many types on damaged files
        kind = path.suffix[1:].upper()
        raise FileProblem(
            path, f"cannot be read as {kind} ({type(error).__name__}: {error})", "Copy or write it again."
        ) from error


def _ply(surface: TriangleSurface, colours: Image | None, values: Mapping[str, Floats]) -> bytes:
    fields = [(axis, "<f8") for axis in "xyz"] + [(name, "<f4") for name in values]
    fields += [(name, "u1") for name in ("red", "green", "blue")] if colours is not None else []
    table = np.zeros(len(surface.vertices_mm), dtype=fields)
    for axis, name in enumerate("xyz"):
        table[name] = surface.vertices_mm[:, axis]
    for name, numbers in values.items():
        table[name] = numbers
    if colours is not None:
        for channel, name in enumerate(("red", "green", "blue")):
            table[name] = colours[:, channel]
    triangles = np.zeros(len(surface.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    triangles["count"], triangles["corners"] = 3, surface.faces
    kinds = {"<f8": "double", "<f4": "float", "u1": "uchar"}
    head = ["ply", "format binary_little_endian 1.0", "comment LPS, millimetres", f"element vertex {len(table)}"]
    head += [f"property {kinds[kind]} {name}" for name, kind in fields]
    head += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header", ""]
    return "\n".join(head).encode("ascii") + table.tobytes() + triangles.tobytes()


def _stl(surface: TriangleSurface, colours: Image | None, values: Mapping[str, Floats]) -> bytes:
    table = np.zeros(len(surface.faces), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    first, second, third = np.moveaxis(surface.corners_mm, 1, 0)
    across = np.cross(second - first, third - first)
    length = np.linalg.norm(across, axis=1, keepdims=True)
    table["normal"] = np.divide(across, length, out=np.zeros_like(across), where=length > 0)
    table["corners"] = surface.corners_mm
    return b"LPS, millimetres".ljust(80) + struct.pack("<I", len(table)) + table.tobytes()


def _vtk(surface: TriangleSurface, colours: Image | None, values: Mapping[str, Floats]) -> bytes:
    count, faces = len(surface.vertices_mm), len(surface.faces)
    polygons = np.column_stack([np.full(faces, 3), surface.faces])
    parts = [
        f"# vtk DataFile Version 3.0\nLPS, millimetres\nBINARY\nDATASET POLYDATA\nPOINTS {count} double\n".encode(),
        surface.vertices_mm.astype(">f8").tobytes(),
        f"\nPOLYGONS {faces} {4 * faces}\n".encode(),
        polygons.astype(">i4").tobytes(),
    ]
    if values or colours is not None:
        parts.append(f"\nPOINT_DATA {count}\n".encode())
    for name, numbers in values.items():
        head = f"SCALARS {name} float 1\nLOOKUP_TABLE default\n"
        parts += [head.encode(), np.asarray(numbers).astype(">f4").tobytes(), b"\n"]
    if colours is not None:
        parts += [b"COLOR_SCALARS colour 3\n", np.asarray(colours, np.uint8).tobytes(), b"\n"]
    return b"".join(parts)


def _glb(surface: TriangleSurface, colours: Image | None, values: Mapping[str, Floats]) -> bytes:
    import trimesh

    mesh = trimesh.Trimesh(
        vertices=surface.vertices_mm @ GLTF_FROM_LPS.T, faces=surface.faces, vertex_colors=colours, process=False
    )
    return bytes(trimesh.Scene(mesh).export(file_type="glb"))


class _VtkText:
    """Reader of the words and numbers of a legacy VTK file, ASCII or binary."""

    def __init__(self, data: bytes, start: int, binary: bool) -> None:
        self.data, self.at, self.binary = data, start, binary

    def word(self) -> str:
        while self.at < len(self.data) and self.data[self.at : self.at + 1].isspace():
            self.at += 1
        begin = self.at
        while self.at < len(self.data) and not self.data[self.at : self.at + 1].isspace():
            self.at += 1
        return self.data[begin : self.at].decode("ascii", "replace")

    def numbers(self, kind: str, count: int) -> np.ndarray:
        if not 0 <= count <= len(self.data) - self.at:
            raise ValueError(f"it states {count} numbers")
        if not self.binary:
            return np.array([float(self.word()) for _ in range(count)])
        dtype = np.dtype({"float": ">f4", "double": ">f8", "int": ">i4", "vtktypeint64": ">i8"}[kind])
        begin = self.data.index(b"\n", self.at) + 1
        self.at = begin + count * dtype.itemsize
        return np.frombuffer(self.data, dtype, count, begin).astype(float)


def _read_vtk(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the points and polygons of a legacy VTK file, versions 1 to 5."""
    data = path.read_bytes()
    try:
        head = data.split(b"\n", 4)
        if not head[0].startswith(b"# vtk DataFile") or head[3].split() != [b"DATASET", b"POLYDATA"]:
            raise MareyError("it is not a legacy POLYDATA file")
        text = _VtkText(data, len(b"\n".join(head[:4])), head[2].strip() == b"BINARY")
        points, faces = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
        while (word := text.word()) and word not in ("POINT_DATA", "CELL_DATA"):
            if word == "POINTS":
                count, kind = int(text.word()), text.word()
                points = text.numbers(kind, 3 * count).reshape(-1, 3)
            elif word == "POLYGONS":
                faces = _vtk_polygons(text)
            elif word == "METADATA":
                while text.data[text.at : text.at + 2] != b"\n\n" and text.at < len(data):
                    text.at += 1
        return points, faces
    except (ValueError, KeyError, IndexError, MareyError) as error:
        raise FileProblem(
            path, f"cannot be read as VTK ({error})", "Write it as legacy polygons, or as PLY."
        ) from error


def _vtk_polygons(text: _VtkText) -> np.ndarray:
    first, second = int(text.word()), int(text.word())
    place = text.at
    if text.word() == "OFFSETS":  # version 5: offsets of the polygons, followed by all corners
        offsets = text.numbers(text.word(), first).astype(np.int64)
        text.word()
        corners = text.numbers(text.word(), second).astype(np.int64)
        sizes = np.diff(offsets)
    else:
        text.at = place
        table = text.numbers("int", second).astype(np.int64).reshape(-1, 4)
        sizes, corners = table[:, 0], table[:, 1:].ravel()
    if len(sizes) and not (sizes == 3).all():
        raise MareyError("it has polygons other than triangles")
    return corners.reshape(-1, 3)
