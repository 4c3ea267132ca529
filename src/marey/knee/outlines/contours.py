"""Outlines of bones and cartilage in the slices of a volume, and the structures interpolated between them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.interpolate import PchipInterpolator

from marey.arrays import Floats, Mask, freeze_fields
from marey.errors import MareyError
from marey.knee.outlines.outlines import filled
from marey.knee.space.distances import signed_distance
from marey.knee.space.structures import LABELS
from marey.knee.space.volume import Labels, VoxelGrid

AXES = ("i", "j", "k")
"""Axes of the voxels along which slices follow each other. Slices across k have rows along j and columns along i, those
across j rows along k and columns along i, those across i rows along k and columns along j."""
_FAR_MM = 1e3
"""Signed distance [mm] outside, before the first and after the last outlined slice; larger than any image."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Contour:
    """One closed outline in one slice."""

    structure: str
    """Name, one of `LABELS`."""
    axis: str
    """One of `AXES`."""
    index: int
    """Index of the slice along its axis."""
    anchors: Floats
    """(A, 2) x and y [px] set by hand; x counts columns, integers are centres of pixels."""
    outline: Floats
    """(N, 2) x and y [px]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "anchors", "outline")


def slice_of(array: np.ndarray, axis: str, index: int) -> np.ndarray:
    """Return a slice (rows, columns) of a volume (k, j, i)."""
    part: np.ndarray = np.take(array, index, axis=_array_axis(axis))
    return part


def slice_shape(grid: VoxelGrid, axis: str) -> tuple[int, int]:
    """Return the numbers of rows and columns of the slices along an axis."""
    rows, columns = (count for each, count in enumerate(grid.shape) if each != _array_axis(axis))
    return rows, columns


def slice_spacing_mm(grid: VoxelGrid, axis: str) -> tuple[float, float]:
    """Return the spacing of rows and of columns of the slices along an axis."""
    rows, columns = (mm for each, mm in enumerate(grid.array_spacing_mm) if each != _array_axis(axis))
    return rows, columns


def slice_count(grid: VoxelGrid, axis: str) -> int:
    """Return the number of slices along an axis."""
    return grid.shape[_array_axis(axis)]


def outlined_mask(contours: Iterable[Contour], shape: tuple[int, int]) -> Mask:
    """Return the mask (rows, columns) of the pixels within any of the outlines of one slice."""
    mask = np.zeros(shape, bool)
    for contour in contours:
        mask |= filled(contour.outline, shape)
    return mask


def slice_distance(contours: Sequence[Contour], grid: VoxelGrid, structure: str, index: int) -> Floats | None:
    """Return the signed distance of a structure in one slice, from its outlines there or in the slices about it.

    Between outlined slices the distances are interpolated as in [Raya1990]; the edge is where the result is 0. Unlike
    the paper, which interpolates linearly, by monotone cubics, which follow the rounded shape of bones.

    Args:
        contours: Outlines of any structures.
        grid: Grid of the volume.
        structure: Name of the structure.
        index: The slice along the axis of the structure's outlines.

    Returns:
        (rows, columns) mm, positive inside; None unless there are outlines on both sides.

    Raises:
        MareyError: The structure's outlines lie across several axes.
    """
    axis, by_slice = _by_slice(contours, structure)
    indices = sorted(by_slice)
    if not indices or not indices[0] <= index <= indices[-1]:
        return None
    if index in by_slice:
        return _distance_to(by_slice[index], grid, axis)
    # A monotone cubic between two slices depends on these and the next ones on either side only.
    after = next(place for place, each in enumerate(indices) if each > index)
    about = indices[max(after - 2, 0) : after + 2]
    between: Floats = _interpolated({each: _distance_to(by_slice[each], grid, axis) for each in about})(index)
    return between


def structure_distance(contours: Sequence[Contour], grid: VoxelGrid, structure: str) -> Floats:
    """Return the signed distance (k, j, i) [mm] in all slices; -1000 before the first and after the last outlined one.

    Raises:
        MareyError: As `slice_distance`, or there is no outline of the structure.
    """
    axis, by_slice = _by_slice(contours, structure)
    if not by_slice:
        raise MareyError(f"There is no outline of the {structure.replace('_', ' ')}.")
    distance = np.full(grid.shape, -_FAR_MM, np.float32)
    slices = np.moveaxis(distance, _array_axis(axis), 0)
    at = _interpolated({index: _distance_to(each, grid, axis) for index, each in sorted(by_slice.items())})
    for index in range(min(by_slice), max(by_slice) + 1):
        slices[index] = at(index)
    return distance


def labels_of_contours(contours: Sequence[Contour], grid: VoxelGrid) -> Labels:
    """Fill all outlines and interpolate between them; a voxel in two structures belongs to the one it is deeper in.

    Raises:
        MareyError: There are no outlines, or those of a structure lie across several axes.
    """
    if not contours:
        raise MareyError("There are no outlines to fill.")
    labels = np.zeros(grid.shape, np.uint8)
    deepest = np.zeros(grid.shape, np.float32)
    for structure in dict.fromkeys(contour.structure for contour in contours):
        distance = structure_distance(contours, grid, structure)
        deeper = distance > deepest
        labels[deeper] = LABELS[structure]
        deepest[deeper] = distance[deeper]
    return Labels(labels=labels, grid=grid)


def _by_slice(contours: Sequence[Contour], structure: str) -> tuple[str, dict[int, tuple[Contour, ...]]]:
    """Return the axis of a structure's outlines, and the outlines by slice."""
    own = [contour for contour in contours if contour.structure == structure]
    axes = sorted({contour.axis for contour in own})
    if len(axes) > 1:
        name = structure.replace("_", " ")
        raise MareyError(
            f"The {name} is outlined in slices across {' and '.join(axes)}: keep those across one of them."
        )
    found: dict[int, tuple[Contour, ...]] = {}
    for contour in own:
        found[contour.index] = (*found.get(contour.index, ()), contour)
    return (axes[0] if axes else AXES[2]), found


@lru_cache(maxsize=16)
def _distance_to(contours: tuple[Contour, ...], grid: VoxelGrid, axis: str) -> Floats:
    rows_mm, columns_mm = slice_spacing_mm(grid, axis)
    mask = outlined_mask(contours, slice_shape(grid, axis))
    return np.asarray(signed_distance(mask, (rows_mm, columns_mm)))


def _interpolated(distances: Mapping[int, Floats]) -> Callable[[int], Floats]:
    if len(distances) == 1:
        alone = next(iter(distances.values()))
        return lambda index: alone
    far = np.maximum(np.array(list(distances.values())), -_FAR_MM)
    between = PchipInterpolator(list(distances), far, axis=0)
    return lambda index: np.asarray(between(index))


def _array_axis(axis: str) -> int:
    return len(AXES) - 1 - AXES.index(axis)
