"""Geometry of patches on the surface of a body, and their information about a shift."""

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import PosedBody
from marey.cameras.visibility import View


def information_along(information: Floats, along: Floats, across_sd: float) -> Floats:
    """Return the information (n,) about a motion along directions when the position across them is unknown.

    Args:
        information: (n, 2, 2) about positions [1/px2].
        along: (n, 2) motion per unit of what is measured [px].
        across_sd: Standard deviation of the position across the motion without observations [px].
    """
    length = np.linalg.norm(along, axis=1)
    unit = along / np.maximum(length, 1e-9)[:, None]
    other = np.stack([-unit[:, 1], unit[:, 0]], 1)
    own, mixed, across = (
        np.einsum("ni,nij,nj->n", a, information, b) for a, b in ((unit, unit), (unit, other), (other, other))
    )
    return np.asarray(np.maximum(own - mixed**2 / (across + across_sd**-2), 0.0) * length**2)


def surface_at(view: View, faces: Integers, pixels: Integers) -> tuple[Integers, Floats]:
    """Return face (n,) and barycentric coordinates (n, 3) of the surface at pixels (n, 2) of an image.

    The coordinates have the perspective of the face. Where no face is visible, the face is -1.
    """
    height, width = view.face.shape
    column, row = (pixels - np.array(view.corner)).T
    inside = (row >= 0) & (column >= 0) & (row < height) & (column < width)
    face = np.full(len(pixels), -1, np.int64)
    face[inside] = view.face[row[inside], column[inside]]
    corners = view.projected[faces[np.maximum(face, 0)]]
    a, b, c = (corners[:, k, :2] - pixels for k in range(3))
    areas = [p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] for p, q in ((b, c), (c, a), (a, b))]
    weights = np.stack(areas, 1) * corners[..., 2]
    total = weights.sum(1, keepdims=True)
    known = np.isfinite(total) & (total != 0)
    return face, np.ascontiguousarray(np.where(known, weights / np.where(known, total, 1.0), 1.0 / 3.0))


def face_normals(vertices: Floats, corners: Integers) -> Floats:
    """Return the outward unit normals (n, 3) of faces with the given corners (n, 3)."""
    a, b, c = (vertices[corners[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12))


def directions_at(posed: PosedBody, corners: Integers, segments: Integers) -> Floats:
    """Return three orthogonal directions (n, 3, 3) at faces with the given corners (n, 3), in frames of segments.

    The first two lie along the face, the third one is its outward normal.
    """
    normal = face_normals(posed.vertices, corners)
    edge = posed.vertices[corners[:, 1]] - posed.vertices[corners[:, 0]]
    first = edge / np.maximum(np.linalg.norm(edge, axis=1, keepdims=True), 1e-12)
    three = np.stack([first, np.cross(normal, first), normal], -1)
    return np.asarray(np.swapaxes(posed.segment_rotation[segments], 1, 2) @ three)


def positive_part(matrices: Floats) -> Floats:
    """Return symmetric matrices (n, 2, 2) with their negative eigenvalues set to zero."""
    values, vectors = np.linalg.eigh(matrices)
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None]) @ np.swapaxes(vectors, 1, 2))


def with_more_noise(information: Floats, variance: Floats) -> Floats:
    """Return the inverse of (information^-1 + variance), for matrices (n, 2, 2) that may be singular."""
    inner = np.eye(2) + variance[:, None, None] * information
    return np.asarray(np.linalg.solve(inner, information))
