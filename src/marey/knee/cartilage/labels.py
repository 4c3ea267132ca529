"""Labels of cartilage from its sheets."""

from collections.abc import Mapping

import numpy as np
from scipy import ndimage

from marey.arrays import Floats
from marey.knee.cartilage.evidence import THICKEST_MM
from marey.knee.cartilage.outer_surface import CartilageSheet
from marey.knee.space.structures import CARTILAGE_OF_BONE, LABELS
from marey.knee.space.triangle_tree import TriangleTree, corner_weights
from marey.knee.space.volume import Labels

MOVED_MM = 2.0
"""Largest distance [mm] of the sheets' inner surfaces from the edges of the bones' voxels; chosen by hand."""


def with_cartilage(bones: Labels, sheets: Mapping[str, CartilageSheet]) -> Labels:
    """Add cartilage to the labels of bones: voxels over a bone that lie nearer to it than the cartilage is thick.

    Where a bone is covered, its voxels are changed to end at the sheet's inner surface, so that no voxel between bone
    and cartilage is left out. Elsewhere bones are kept.

    Args:
        bones: On the image's own grid; its labels of cartilage are removed.
        sheets: Bone's name to the cartilage on it.

    Returns:
        Bones and cartilage. A voxel within two cartilages belongs to the one of which the smaller share lies below it.
    """
    labels = np.where(np.isin(bones.labels, [LABELS[bone] for bone in CARTILAGE_OF_BONE]), bones.labels, 0)
    best = np.full(labels.shape, np.inf)
    for bone, sheet in sheets.items():
        box = _box(bones, sheet)
        part, share = labels[box], best[box]
        own = part == LABELS[bone]
        taken = np.isin(part, [LABELS[name] for name in CARTILAGE_OF_BONE if name != bone])
        reach = [2 * int(MOVED_MM / spacing) + 1 for spacing in bones.grid.array_spacing_mm]
        deep = ndimage.minimum_filter(own, reach)
        free = np.argwhere(~taken & ~deep)
        offset = np.array([axis.start for axis in box])
        height, thickness = _heights(sheet, bones.grid.lps((free + offset)[:, ::-1]))
        covered = thickness > 0
        below = covered & (height <= 0) & (height > -MOVED_MM)
        part[tuple(free[below].T)] = LABELS[bone]
        share[tuple(free[below].T)] = -np.inf
        over = covered & (height > 0)
        # Voxels of the bone that lie over the cartilage are neither.
        crust = over & (height > thickness) & (height < MOVED_MM) & own[tuple(free.T)]
        part[tuple(free[crust].T)] = 0
        ratio = np.where(over & (height <= thickness), height / np.maximum(thickness, 1e-9), np.inf)
        at = tuple(free.T)
        won = ratio < share[at]
        spots = tuple(axis[won] for axis in at)
        share[spots] = ratio[won]
        part[spots] = LABELS[CARTILAGE_OF_BONE[bone]]
    return Labels(labels=labels, grid=bones.grid)


def _box(labels: Labels, sheet: CartilageSheet) -> tuple[slice, ...]:
    covered = sheet.bone.vertices_mm[sheet.thickness_mm > 0]
    if not len(covered):
        return (slice(0, 0),) * 3
    low, high = covered.min(0) - THICKEST_MM, covered.max(0) + THICKEST_MM
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), -1).reshape(-1, 3)
    voxels = labels.grid.voxels(corners)[:, ::-1]
    first = np.clip(np.floor(voxels.min(0)), 0, labels.labels.shape).astype(int)
    last = np.clip(np.ceil(voxels.max(0)) + 1, 0, labels.labels.shape).astype(int)
    return tuple(slice(a, b) for a, b in zip(first, last, strict=True))


def _heights(sheet: CartilageSheet, places: Floats) -> tuple[Floats, Floats]:
    """Return the height of positions (n, 3) over the bone, negative within it, and the thickness of cartilage there."""
    surface = sheet.bone
    covered = sheet.thickness_mm > 0
    thickness, height = np.zeros(len(places)), np.full(len(places), np.inf)
    near = TriangleTree.of(surface).nearest(places, THICKEST_MM)
    close = near.distance_mm < THICKEST_MM
    faces = surface.faces[near.face[close]]
    corners = surface.vertices_mm[faces]
    weights = corner_weights(corners, near.points_mm[close])
    thickness[close] = np.einsum("nk,nk->n", weights, sheet.thickness_mm[faces])
    # Between a covered and a bare corner the rim runs halfway.
    half = np.einsum("nk,nk->n", weights, covered[faces].astype(float))
    thickness[close] = np.where(half > 0.5, thickness[close] / np.maximum(half, 0.5), 0.0)
    facing = np.einsum("nk,nki->ni", weights, surface.vertex_normals[faces])
    side = np.einsum("ni,ni->n", places[close] - near.points_mm[close], facing)
    height[close] = np.sign(side) * near.distance_mm[close]
    return height, thickness
