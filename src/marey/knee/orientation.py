"""Faces of a mesh that turn the other way than their neighbours, and vertices that lie at one place."""

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from marey.arrays import Mask
from marey.knee.surface import Surface


def joined(surface: Surface) -> Surface:
    """Join vertices at one place, as a mesh of single triangles has them; they are sorted anew."""
    places, number = np.unique(surface.vertices_mm, axis=0, return_inverse=True)
    if len(places) == len(surface.vertices_mm):
        return surface
    return Surface(vertices_mm=places, faces=number.reshape(-1)[surface.faces])


def turned_alike(surface: Surface) -> tuple[Surface, Mask]:
    """Turn faces so that neighbours agree, and each piece outward by the volume it encloses.

    Args:
        surface: Closed or open; its vertices stay.

    Returns:
        The surface, and which faces (T,) were turned. Where the majority of a piece turned inward, that is all of it.
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
    for each in range(pieces):
        own = piece == each
        corners = surface.vertices_mm[faces[own]]
        corners = corners - corners.mean((0, 1))
        if np.einsum("ti,ti->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0:
            turned[own] = ~turned[own]
    faces = np.where(turned[:, None], surface.faces[:, ::-1], surface.faces)
    return Surface(vertices_mm=surface.vertices_mm, faces=faces), turned
