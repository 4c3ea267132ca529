"""Visual hull of a person: the space that all silhouettes have in common."""

from collections.abc import Container, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import scipy.ndimage

from marey.arrays import Floats, Mask
from marey.cameras import lens
from marey.cameras.camera import Camera
from marey.compiled.kernels import kernel


def visual_hull(cameras: Sequence[Camera], masks: Sequence[Mask], *, cell: float = 0.04, reach: float = 1.4) -> Floats:
    """Return the cells of space whose centres lie in the silhouette of every camera that has them in view.

    Args:
        cameras: At least two with a silhouette.
        masks: (height, width) of each camera; an empty mask is ignored.
        cell: Edge of the cells [m].
        reach: Half the edge of the cube that is searched, about the point where the lines of sight meet [m].

    Returns:
        (n, 3) centres of the filled cells [m]; empty if the silhouettes have no point in common.
    """
    seeing = [(camera, mask) for camera, mask in zip(cameras, masks, strict=True) if mask.any()]
    if not seeing:
        return np.zeros((0, 3))
    grid = HullGrid.about(meeting_point(seeing), reach, cell)
    # A cell must be in view of at least two cameras.
    return grid.centres(filled(seeing, grid, witnesses=min(2, len(seeing))))


@dataclass(frozen=True, eq=False)
class HullGrid:
    """Cells of space in rows, columns and layers along the world's axes."""

    origin: Floats
    """(3,) centre of the first cell [m]."""
    cell: float
    """Edge of a cell [m]."""
    counts: tuple[int, int, int]
    """Number of cells along each axis."""

    @staticmethod
    def about(centre: Floats, reach: float, cell: float) -> "HullGrid":
        """Return a cube of cells, given its middle (3,) and half its edge [m]."""
        half = round(reach / cell)
        return HullGrid(centre - half * cell, cell, (2 * half + 1,) * 3)

    @staticmethod
    def holding(points: Floats, margin: float, cell: float) -> "HullGrid":
        """Return a grid that contains points (n, 3) with a margin on all sides [m]."""
        origin = points.min(0) - margin
        x, y, z = np.ceil((points.max(0) + margin - origin) / cell).astype(int) + 1
        return HullGrid(origin, cell, (int(x), int(y), int(z)))

    def centres(self, chosen: Mask) -> Floats:
        """Return the centres (n, 3) of chosen cells [m]."""
        return np.asarray(self.origin + np.argwhere(chosen) * self.cell, float)


def filled(seeing: Sequence[tuple[Camera, Mask]], grid: HullGrid, *, witnesses: int) -> Mask:
    """Return the cells of a grid that lie in the silhouette of every camera that has them in view.

    Args:
        seeing: Cameras with their silhouettes.
        grid: The cells.
        witnesses: Least number of cameras that must have a cell in view.
    """
    widths = np.array([camera.width for camera, _ in seeing])
    heights = np.array([camera.height for camera, _ in seeing])
    masks = np.zeros((len(seeing), heights.max(), widths.max()), bool)
    for c, (_, mask) in enumerate(seeing):
        masks[c, : heights[c], : widths[c]] = mask
    packed = np.array([camera.packed for camera, _ in seeing])
    return np.asarray(_filled(packed, widths, heights, masks, grid.origin, grid.cell, grid.counts, witnesses))


@kernel
def _filled(packed, widths, heights, masks, origin, cell, counts, witnesses):
    inside = np.zeros(counts, np.bool_)
    # Column by column of cells, so that their projection is vectorised; most columns end with the first camera.
    points, pixels = np.empty((counts[2], 3)), np.empty((counts[2], 3))
    seen = np.empty(counts[2], np.int64)
    for i in range(counts[0]):
        for j in range(counts[1]):
            seen[:] = 0
            for k in range(counts[2]):
                points[k, 0], points[k, 1] = origin[0] + i * cell, origin[1] + j * cell
                points[k, 2] = origin[2] + k * cell
            for c in range(len(packed)):
                lens.project_points(packed[c], points, pixels)
                if _look_at(pixels, masks[c], widths[c], heights[c], seen) == 0:
                    break
            for k in range(counts[2]):
                inside[i, j, k] = seen[k] >= witnesses
    return inside


@kernel
def _look_at(pixels, mask, width, height, seen):
    """Count a camera that has points (n, 3) in view; -1 is a point beside a silhouette. Return how many are not."""
    left = 0
    for k in range(len(seen)):
        if seen[k] < 0:
            continue
        column, row = pixels[k, 0], pixels[k, 1]
        # Outside the lens' range the pixel is NaN, and no comparison holds.
        if -0.5 <= column <= width - 0.5 and -0.5 <= row <= height - 0.5:
            shown = mask[min(int(row + 0.5), height - 1), min(int(column + 0.5), width - 1)]
            seen[k] = seen[k] + 1 if shown else -1
        left += seen[k] >= 0
    return left


def common_parts(
    cameras: Sequence[Camera], masks: Sequence[Mask], *, cell: float = 0.04, cut: Container[int] = ()
) -> list[Mask]:
    """Reduce silhouettes to the largest object that appears in all of them.

    Ours: what only some cameras show as a person (a person in the background, furniture that was moved since the empty
    room was filmed) has no common place in space. Parts of the person that a single camera misses are missing in all of
    them afterwards.

    Args:
        cameras: At least two with a silhouette.
        masks: (height, width) of each camera.
        cell: Edge of the cells of space [m].
        cut: Numbers of cameras in which something hides a part of the object: what they lack does not count.
    """
    whole = [(c, camera, mask) for c, (camera, mask) in enumerate(zip(cameras, masks, strict=True)) if mask.any()]
    seeing = [(camera, mask) for c, camera, mask in whole if c not in cut]
    witnesses = min(3, len(seeing))
    if witnesses < 2:
        return [np.asarray(mask) for mask in masks]
    centre, reach = room_between([camera for camera, _ in seeing])
    rough = HullGrid.about(centre, reach, 3 * cell)
    somewhere = rough.centres(largest_part(filled(seeing, rough, witnesses=witnesses)))
    if len(somewhere) == 0:
        return [np.zeros_like(mask) for mask in masks]
    grid = HullGrid.holding(somewhere, 0.5, cell)
    cells = grid.centres(largest_part(filled(seeing, grid, witnesses=witnesses)))
    return [mask & drawn_cells(camera, cells, cell) for camera, mask in zip(cameras, masks, strict=True)]


def room_between(cameras: Sequence[Camera]) -> tuple[Floats, float]:
    """Return the point (3,) nearest to the cameras' axes, and the largest distance of a person from it [m]."""
    middle = [np.array([[0.5 * (camera.width - 1), 0.5 * (camera.height - 1)]]) for camera in cameras]
    axes = [camera.rays(pixel).directions[0] for camera, pixel in zip(cameras, middle, strict=True)]
    centres = np.array([camera.centre for camera in cameras])
    point = nearest_point(centres, np.array(axes))
    return point, 0.8 * float(np.median(np.linalg.norm(centres - point, axis=1)))


def largest_part(cells: Mask) -> Mask:
    """Return the largest connected part of a grid's cells (x, y, z); cells that touch at corners are connected."""
    parts, count = scipy.ndimage.label(cells, np.ones((3, 3, 3)))
    if count == 0:
        return cells
    return np.asarray(parts == 1 + np.argmax(np.bincount(parts.ravel())[1:]))


def drawn_cells(camera: Camera, cells: Floats, cell: float) -> Mask:
    """Draw cells of space (n, 3) in a camera's image (height, width), each slightly larger than it is."""
    cells = np.ascontiguousarray(cells)  # With another layout, the kernel would be compiled once more.
    pixels = np.empty_like(cells)
    lens.project_points(camera.packed, cells, pixels)
    shown = camera.sees(pixels[:, :2])
    column, row = np.round(pixels[shown, :2]).astype(int).T
    drawn = np.zeros((camera.height, camera.width), np.uint8)
    drawn[np.clip(row, 0, camera.height - 1), np.clip(column, 0, camera.width - 1)] = 1
    if not shown.any():
        return drawn > 0
    reach = int(np.ceil(np.linalg.norm(camera.matrix[0, :2]) * np.median(pixels[shown, 2]) * cell))
    return np.asarray(cv2.dilate(drawn, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))) > 0


def meeting_point(seeing: Sequence[tuple[Camera, Mask]]) -> Floats:
    """Return the point (3,) nearest to the rays through the silhouettes' centroids [m]."""
    centroids = [np.argwhere(mask).mean(0)[None, ::-1] for _, mask in seeing]
    rays = [camera.rays(pixel).directions[0] for (camera, _), pixel in zip(seeing, centroids, strict=True)]
    return nearest_point(np.array([camera.centre for camera, _ in seeing]), np.array(rays))


def nearest_point(origins: Floats, directions: Floats) -> Floats:
    """Return the point (3,) nearest to lines through origins (n, 3) along unit directions (n, 3)."""
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    right = np.einsum("nij,nj->i", across, origins)
    return np.asarray(np.linalg.lstsq(across.sum(0), right, rcond=None)[0], float)
