"""Closed surfaces of bones and cartilage from where their edges lie in a volume, without the staircase of slices."""

from typing import Any

import numpy as np
from scipy import ndimage, sparse

from marey.arrays import Floats, Integers
from marey.errors import MareyError
from marey.extras import import_optional
from marey.knee.space.distances import signed_distance
from marey.knee.space.resampling import resampled, upright_grid
from marey.knee.space.structures import BONE_OF_CARTILAGE
from marey.knee.space.surface import Surface
from marey.knee.space.volume import Grid, Labels

_FINEST_MM = 0.6
_BLUR = 0.4
"""Standard deviation of the smoothing, in distances of slices: just enough that the slices are not seen."""
_LAMBDA, _MU = 0.5, -0.53
"""Steps of [Taubin1995]: inward, and outward again by a little more, so that nothing shrinks."""
_ROUNDS = 10
_CRUMB = 0.1
_OFF_LEVEL = 1e-4
"""In millimetres: nothing, but no zero."""
_FINER = 1.25
"""By so much more triangles stay where fewer would not leave a closed surface."""


def surface_of_field(
    distance_mm: np.ndarray, grid: Grid, *, edge_mm: float = 1.0, several: bool = False
) -> Surface:  # fmt: skip
    """Make a closed surface where a signed distance is zero: each edge has two faces.

    Args:
        distance_mm: (k, j, i) positive inside; where the array ends, so does the body, by a flat cut.
        grid: Of the distance; its determinant may be negative.
        edge_mm: Length of the triangles' edges to which the surface is thinned out; shorter where a sheet is too thin
            for them, as cartilage of 2 mm is for 3 mm.
        several: Keep all pieces but crumbs, as of cartilage, which lies on a tibia in two; otherwise the largest alone.

    Raises:
        MareyError: The field has no inside, or scikit-image or fast-simplification are not installed.
    """
    cube_mm = max(_FINEST_MM, 0.6 * edge_mm)
    sigma = _BLUR * grid.spacing_mm.max() / cube_mm
    # Deep inside is no deeper than the smoothing reaches: otherwise what the image cuts off would stay open.
    reach = int(np.ceil(3 * sigma)) + 1
    cubes = _padded(upright_grid(grid, cube_mm), reach + 1)
    most = reach * cube_mm
    field = resampled(np.clip(distance_mm, -most, most).astype(np.float32), grid, cubes, outside=-most)
    smooth = ndimage.gaussian_filter(field, sigma, truncate=3.0)
    if smooth.max() <= 0:
        raise MareyError("There is nothing to make a surface of.")
    vertices, faces = _marched(smooth)
    surface = _pieces(_turned_out(cubes.lps(vertices[:, ::-1]), faces), _CRUMB if several else 1.0)
    return _thinned(smoothed_surface(surface), edge_mm)


def surface_of_labels(labels: Labels, structure: str, *, edge_mm: float = 1.0) -> Surface:
    """Make a surface of a structure in a volume of labels.

    Raises:
        MareyError: The structure is not in it.
    """
    mask = labels.mask(structure)
    if not mask.any():
        raise MareyError(f"The labels hold no {structure.replace('_', ' ')}.")
    filled = np.argwhere(mask)
    low, high = np.maximum(filled.min(axis=0) - 3, 0), np.minimum(filled.max(axis=0) + 4, mask.shape)
    box = tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    lps_from_voxel = labels.grid.lps_from_voxel.copy()
    lps_from_voxel[:3, 3] = labels.grid.lps(low[::-1].astype(float))
    part = mask[box]
    grid = Grid(shape=(part.shape[0], part.shape[1], part.shape[2]), lps_from_voxel=lps_from_voxel)
    several = structure in BONE_OF_CARTILAGE
    return surface_of_field(signed_distance(part, grid.array_spacing_mm), grid, edge_mm=edge_mm, several=several)


def smoothed_surface(surface: Surface, rounds: int = _ROUNDS) -> Surface:
    """Smooth a surface without shrinking it, after [Taubin1995]; its volume is kept to the last digit."""
    neighbours = _neighbour_mean(surface.faces, len(surface.vertices_mm))
    vertices = surface.vertices_mm.copy()
    for _ in range(rounds):
        for step in (_LAMBDA, _MU):
            vertices += step * (neighbours @ vertices - vertices)
    smooth = Surface(vertices_mm=vertices, faces=surface.faces)
    if smooth.volume_mm3 <= 0:
        return smooth
    middle = vertices.mean(axis=0)
    scale = (surface.volume_mm3 / smooth.volume_mm3) ** (1 / 3)
    return Surface(vertices_mm=middle + scale * (vertices - middle), faces=surface.faces)


def _padded(grid: Grid, rim: int) -> Grid:
    lps_from_voxel = grid.lps_from_voxel.copy()
    lps_from_voxel[:3, 3] = grid.lps(np.full(3, -float(rim)))
    k, j, i = (count + 2 * rim for count in grid.shape)
    return Grid(shape=(k, j, i), lps_from_voxel=lps_from_voxel)


def _marched(field: np.ndarray) -> tuple[Floats, Integers]:
    measure: Any = import_optional("skimage.measure", extra="knee", purpose="Surfaces of bones")
    # Where the level is met on the spot, several edges meet it there at once, and the surface would be pinched.
    vertices, faces, _, _ = measure.marching_cubes(np.where(field == 0, np.float32(_OFF_LEVEL), field), 0.0)
    return vertices.astype(np.float64), faces.astype(np.int64)


def _turned_out(vertices: Floats, faces: Integers) -> Surface:
    surface = Surface(vertices_mm=vertices, faces=faces)
    return surface if surface.volume_mm3 > 0 else Surface(vertices_mm=vertices, faces=faces[:, ::-1])


def _pieces(surface: Surface, least: float) -> Surface:
    """Keep the pieces with at least such a share of the largest one's vertices: crumbs and inner bubbles go."""
    count = len(surface.vertices_mm)
    ends = surface.faces[:, [0, 1]], surface.faces[:, [1, 2]]
    pairs = np.concatenate(ends)
    links = sparse.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    _, piece = sparse.csgraph.connected_components(links, directed=False)
    sizes = np.bincount(piece)
    keep = (sizes >= least * sizes.max())[piece]
    number = np.cumsum(keep) - 1
    faces = surface.faces[keep[surface.faces[:, 0]]]
    return Surface(vertices_mm=surface.vertices_mm[keep], faces=number[faces])


def _neighbour_mean(faces: Integers, count: int) -> sparse.csr_matrix:
    first = faces[:, [0, 1, 2, 1, 2, 0]].ravel()
    second = faces[:, [1, 2, 0, 0, 1, 2]].ravel()
    links = sparse.csr_matrix((np.ones(len(first)), (first, second)), shape=(count, count))
    links.data[:] = 1.0
    return sparse.diags(1 / np.maximum(np.asarray(links.sum(axis=1)).ravel(), 1)) @ links


def _thinned(surface: Surface, edge_mm: float) -> Surface:
    """Take triangles away where they are finer than asked, the flattest places first, as long as no sheet is pinched.

    Thinned too far, the two sides of cartilage meet in an edge or a face. Then it stays finer, at most as it was.
    """
    wanted = int(surface.area_mm2 / (0.433 * edge_mm**2))
    while wanted < len(surface.faces):
        simplify = import_optional("fast_simplification", extra="knee", purpose="Surfaces of bones")
        vertices, faces = simplify.simplify(
            surface.vertices_mm.astype(np.float32), surface.faces.astype(np.int32), 1 - wanted / len(surface.faces)
        )
        if _is_closed(faces):
            return Surface(vertices_mm=vertices.astype(np.float64), faces=faces.astype(np.int64))
        wanted = int(_FINER * wanted) + 1
    return surface


def _is_closed(faces: Integers) -> bool:
    """Tell whether each edge has one face on either side, neither less nor more."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    shared = np.unique(edges @ [int(faces.max(initial=0)) + 1, 1], return_counts=True)[1]
    return bool((shared == 2).all())
