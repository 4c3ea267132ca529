"""Repair of meshes: single triangles joined, faces oriented consistently, small holes closed."""

from itertools import pairwise

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from marey.arrays import Integers, Mask
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.triangle_tree import TriangleTree


def joined(surface: TriangleSurface) -> TriangleSurface:
    """Join vertices at the same position, as in a mesh of single triangles; the vertices are sorted."""
    places, number = np.unique(surface.vertices_mm, axis=0, return_inverse=True)
    if len(places) == len(surface.vertices_mm):
        return surface
    return TriangleSurface(vertices_mm=places, faces=number.reshape(-1)[surface.faces])


def consistently_oriented(surface: TriangleSurface) -> tuple[TriangleSurface, Mask]:
    """Orient faces so that neighbours agree and each piece faces outward; a piece within another one faces inward.

    Args:
        surface: Closed or open; its vertices are kept.

    Returns:
        The surface, and which faces (T,) were reversed.
    """
    ring = joined(surface).faces
    edges = np.concatenate([ring[:, [0, 1]], ring[:, [1, 2]], ring[:, [2, 0]]])
    face = np.tile(np.arange(len(ring)), 3)
    forward = edges[:, 0] < edges[:, 1]
    order = np.lexsort((face, edges.max(1), edges.min(1)))
    low, high, face, forward = edges.min(1)[order], edges.max(1)[order], face[order], forward[order]
    same = (low[1:] == low[:-1]) & (high[1:] == high[:-1])
    first, second, against = face[:-1][same], face[1:][same], (forward[1:] == forward[:-1])[same]
    links = sparse.csr_matrix((np.ones(2 * len(first)), (np.r_[first, second], np.r_[second, first])), (len(ring),) * 2)
    signs = {(int(a), int(b)): bool(t) for a, b, t in zip(first, second, against, strict=True) if t}
    pieces, piece = csgraph.connected_components(links, directed=False)
    turned = np.zeros(len(ring), bool)
    starts = np.unique(piece, return_index=True)[1]
    if signs:
        for start in starts:
            walk, before = csgraph.breadth_first_order(links, int(start), directed=False)
            for here in walk[1:]:
                there = int(before[here])
                turned[here] = turned[there] != (signs.get((there, int(here))) or signs.get((int(here), there), False))
    faces = np.where(turned[:, None], surface.faces[:, ::-1], surface.faces)
    hollow = _within_others(surface, piece)
    for each in range(pieces):
        own = piece == each
        corners = surface.vertices_mm[faces[own]]
        corners = corners - corners.mean((0, 1))
        volume = np.einsum("ti,ti->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
        if (volume > 0) == hollow[each]:
            turned[own] = ~turned[own]
    faces = np.where(turned[:, None], surface.faces[:, ::-1], surface.faces)
    return TriangleSurface(vertices_mm=surface.vertices_mm, faces=faces), turned


def _within_others(surface: TriangleSurface, piece: Integers) -> Mask:
    """Return which pieces lie within others, by the surfaces beyond their extreme points.

    Args:
        surface: All pieces.
        piece: (T,) number of the piece of each face.
    """
    corner = surface.corners_mm[..., 0]
    order = np.lexsort((-corner.max(1), piece))
    utmost = order[np.unique(piece[order], return_index=True)[1]]
    starts = surface.corners_mm[utmost, corner[utmost].argmax(1)]
    reach = float(np.ptp(corner)) + 1.0
    crossed = TriangleTree.of(surface).crossings(starts + (1e-4, 0, 0), np.tile((1.0, 0, 0), (len(starts), 1)), reach)
    return np.asarray(np.isfinite(crossed.distance_mm).sum(1) % 2 == 1)


def with_holes_closed(surface: TriangleSurface, most_edges: int) -> tuple[TriangleSurface, int, int]:
    """Close holes of few edges by triangles about one of their corners.

    Args:
        surface: With consistently oriented faces; its vertices are kept.
        most_edges: A hole with more edges stays open.

    Returns:
        The surface, the number of holes that were closed, and the number of edges that are still open.
    """
    places, number = np.unique(surface.vertices_mm, axis=0, return_inverse=True)
    number = number.reshape(-1)
    ring = number[surface.faces]
    edges = np.concatenate([ring[:, [0, 1]], ring[:, [1, 2]], ring[:, [2, 0]]])
    code, back = edges @ [len(places), 1], edges @ [1, len(places)]
    open_edges = edges[~np.isin(code, back)]
    # The rim of a hole runs in the direction opposite to the faces along it.
    onward: dict[int, list[int]] = {}
    for first, second in open_edges.tolist():
        onward.setdefault(second, []).append(first)
    vertex = np.zeros(len(places), np.int64)
    vertex[number] = np.arange(len(number))
    patches, closed, left = [], 0, 0
    for start in list(onward):
        while onward.get(start):
            rim = [start]
            while onward.get(rim[-1]):
                rim.append(onward[rim[-1]].pop())
                if rim[-1] == start:
                    break
            if rim[-1] != start or len(rim) - 1 > most_edges:
                left += len(rim) - 1
                continue
            closed += 1
            patches += [[rim[0], a, b] for a, b in pairwise(rim[1:-1])]
    faces = np.concatenate([surface.faces, vertex[np.array(patches)]]) if patches else surface.faces
    return TriangleSurface(vertices_mm=surface.vertices_mm, faces=faces), closed, left
