"""Closed surfaces of bones and cartilage from signed distances in a volume, without the steps of slices."""

from typing import Any

import numpy as np
from scipy import ndimage, sparse

from marey.arrays import Floats, Integers
from marey.errors import MareyError
from marey.extras import import_optional
from marey.knee.space.distances import signed_distance
from marey.knee.space.resampling import resampled, upright_grid
from marey.knee.space.structures import BONE_OF_CARTILAGE
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.volume import Labels, VoxelGrid

_FINEST_MM = 0.6
"""Least edge [mm] of the cubes of marching cubes; chosen by hand."""
_BLUR = 0.4
"""Standard deviation of the smoothing, in slice spacings: just enough that the slices are not visible."""
_LAMBDA, _MU = 0.5, -0.53
"""Steps of [Taubin1995]: inward, and outward again by a little more, so that the surface does not shrink."""
_ROUNDS = 10
"""Number of pairs of such steps; chosen by hand."""
_CRUMB = 0.1
"""Pieces with a smaller share of the largest one's vertices are removed; chosen by hand."""
_OFF_LEVEL = 1e-4
"""Distance [mm] that replaces zero at a vertex of a cube: negligible, but not zero."""
_FINER = 1.25
"""Factor by which the number of triangles is raised until the thinned surface is closed; chosen by hand."""


def surface_of_field(
    distance_mm: np.ndarray, grid: VoxelGrid, *, edge_mm: float = 1.0, several: bool = False
) -> TriangleSurface:  # fmt: skip
    """Return the closed surface where a signed distance is zero, on which each edge has two faces.

    Args:
        distance_mm: (k, j, i) positive inside; where the array ends, the body ends in a flat cut.
        grid: Of the distance; its determinant may be negative.
        edge_mm: Length of the triangles' edges to which the surface is thinned; shorter where a sheet is too thin, as
            cartilage of 2 mm is for 3 mm.
        several: Keep all pieces except very small ones, as for the cartilage on a tibia, which has two; otherwise only
            the largest piece.

    Raises:
        MareyError: The field has no inside, or scikit-image or fast-simplification are not installed.
    """
    cube_mm = max(_FINEST_MM, 0.6 * edge_mm)
    sigma = _BLUR * grid.spacing_mm.max() / cube_mm
    # Distances are limited to the reach of the smoothing: otherwise ends cut off by the image would stay open.
    reach = int(np.ceil(3 * sigma)) + 1
    cubes = _padded(upright_grid(grid, cube_mm), reach + 1)
    most = reach * cube_mm
    field = resampled(np.clip(distance_mm, -most, most).astype(np.float32), grid, cubes, outside=-most)
    smooth = ndimage.gaussian_filter(field, sigma, truncate=3.0)
    if smooth.max() <= 0:
        raise MareyError("The signed distance is nowhere negative, so that there is no surface.")
    vertices, faces = _marched(smooth)
    surface = _pieces(_oriented_outward(cubes.lps(vertices[:, ::-1]), faces), _CRUMB if several else 1.0)
    return _thinned(smoothed_surface(surface), edge_mm)


def surface_of_labels(labels: Labels, structure: str, *, edge_mm: float = 1.0) -> TriangleSurface:
    """Return the surface of a structure in a volume of labels.

    Raises:
        MareyError: The labels do not contain the structure.
    """
    mask = labels.mask(structure)
    if not mask.any():
        raise MareyError(f"The labels contain no {structure.replace('_', ' ')}.")
    filled = np.argwhere(mask)
    low, high = np.maximum(filled.min(axis=0) - 3, 0), np.minimum(filled.max(axis=0) + 4, mask.shape)
    box = tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    lps_from_voxel = labels.grid.lps_from_voxel.copy()
    lps_from_voxel[:3, 3] = labels.grid.lps(low[::-1].astype(float))
    part = mask[box]
    grid = VoxelGrid(shape=(part.shape[0], part.shape[1], part.shape[2]), lps_from_voxel=lps_from_voxel)
    several = structure in BONE_OF_CARTILAGE
    return surface_of_field(signed_distance(part, grid.array_spacing_mm), grid, edge_mm=edge_mm, several=several)


def smoothed_surface(surface: TriangleSurface, rounds: int = _ROUNDS) -> TriangleSurface:
    """Smooth a surface without shrinking it, after [Taubin1995]; its volume is kept exactly."""
    neighbours = _neighbour_mean(surface.faces, len(surface.vertices_mm))
    vertices = surface.vertices_mm.copy()
    for _ in range(rounds):
        for step in (_LAMBDA, _MU):
            vertices += step * (neighbours @ vertices - vertices)
    smooth = TriangleSurface(vertices_mm=vertices, faces=surface.faces)
    if smooth.volume_mm3 <= 0:
        return smooth
    middle = vertices.mean(axis=0)
    scale = (surface.volume_mm3 / smooth.volume_mm3) ** (1 / 3)
    return TriangleSurface(vertices_mm=middle + scale * (vertices - middle), faces=surface.faces)


def _padded(grid: VoxelGrid, rim: int) -> VoxelGrid:
    lps_from_voxel = grid.lps_from_voxel.copy()
    lps_from_voxel[:3, 3] = grid.lps(np.full(3, -float(rim)))
    k, j, i = (count + 2 * rim for count in grid.shape)
    return VoxelGrid(shape=(k, j, i), lps_from_voxel=lps_from_voxel)


def _marched(field: np.ndarray) -> tuple[Floats, Integers]:
    measure: Any = import_optional("skimage.measure", extra="knee", purpose="Surfaces of bones")
    # A distance of exactly zero would be crossed by several edges at one point, and pinch the surface.
    vertices, faces, _, _ = measure.marching_cubes(np.where(field == 0, np.float32(_OFF_LEVEL), field), 0.0)
    return vertices.astype(np.float64), faces.astype(np.int64)


def _oriented_outward(vertices: Floats, faces: Integers) -> TriangleSurface:
    surface = TriangleSurface(vertices_mm=vertices, faces=faces)
    return surface if surface.volume_mm3 > 0 else TriangleSurface(vertices_mm=vertices, faces=faces[:, ::-1])


def _pieces(surface: TriangleSurface, least: float) -> TriangleSurface:
    """Keep the pieces with at least a given share of the largest one's vertices: no specks and inner bubbles."""
    count = len(surface.vertices_mm)
    ends = surface.faces[:, [0, 1]], surface.faces[:, [1, 2]]
    pairs = np.concatenate(ends)
    links = sparse.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    _, piece = sparse.csgraph.connected_components(links, directed=False)
    sizes = np.bincount(piece)
    keep = (sizes >= least * sizes.max())[piece]
    number = np.cumsum(keep) - 1
    faces = surface.faces[keep[surface.faces[:, 0]]]
    return TriangleSurface(vertices_mm=surface.vertices_mm[keep], faces=number[faces])


def _neighbour_mean(faces: Integers, count: int) -> sparse.csr_matrix:
    first = faces[:, [0, 1, 2, 1, 2, 0]].ravel()
    second = faces[:, [1, 2, 0, 0, 1, 2]].ravel()
    links = sparse.csr_matrix((np.ones(len(first)), (first, second)), shape=(count, count))
    links.data[:] = 1.0
    return sparse.diags(1 / np.maximum(np.asarray(links.sum(axis=1)).ravel(), 1)) @ links


def _thinned(surface: TriangleSurface, edge_mm: float) -> TriangleSurface:
    """Reduce the number of triangles to the wanted edge length, flattest places first, while the surface stays closed.

    If it is thinned too far, the two sides of cartilage meet in an edge or a face. Then more triangles are kept.
    """
    wanted = int(surface.area_mm2 / (0.433 * edge_mm**2))
    while wanted < len(surface.faces):
        simplify = import_optional("fast_simplification", extra="knee", purpose="Surfaces of bones")
        vertices, faces = simplify.simplify(
            surface.vertices_mm.astype(np.float32), surface.faces.astype(np.int32), 1 - wanted / len(surface.faces)
        )
        if _is_closed(faces):
            return TriangleSurface(vertices_mm=vertices.astype(np.float64), faces=faces.astype(np.int64))
        wanted = int(_FINER * wanted) + 1
    return surface


def _is_closed(faces: Integers) -> bool:
    """Return whether each edge has exactly two faces."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    shared = np.unique(edges @ [int(faces.max(initial=0)) + 1, 1], return_counts=True)[1]
    return bool((shared == 2).all())
