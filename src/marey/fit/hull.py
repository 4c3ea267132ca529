"""The visual hull: where in space a person may be whose silhouettes are known."""

from collections.abc import Sequence

import numpy as np

from marey.arrays import Floats, Mask
from marey.cameras.camera import Camera


def visual_hull(cameras: Sequence[Camera], masks: Sequence[Mask], *, cell: float = 0.04, reach: float = 1.4) -> Floats:
    """Fill the space whose points lie in every silhouette that has them in its picture.

    Args:
        cameras: at least two that see something.
        masks: (height, width) of each; an empty one says nothing.
        cell: edge of the cells [m].
        reach: half the edge of the cube that is searched, about the point where the lines of sight meet [m].

    Returns:
        (n, 3) centres of the filled cells [m]; empty where the silhouettes have nothing in common.
    """
    seeing = [(camera, mask) for camera, mask in zip(cameras, masks, strict=True) if mask.any()]
    if not seeing:
        return np.zeros((0, 3))
    centre = meeting_point(seeing)
    steps = np.arange(-reach, reach + cell / 2, cell)
    grid = centre + np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    inside = np.ones(len(grid), bool)
    witnesses = np.zeros(len(grid), int)
    for camera, mask in seeing:
        index = np.flatnonzero(inside)
        pixels = camera.project(grid[index])
        shown = camera.sees(pixels)
        column, row = np.round(pixels[shown]).astype(int).T
        column, row = np.clip(column, 0, camera.width - 1), np.clip(row, 0, camera.height - 1)
        inside[index[shown]] = mask[row, column]
        witnesses[index[shown]] += 1
    # A cell that fewer than two cameras have in view is anybody's guess.
    return grid[inside & (witnesses >= min(2, len(seeing)))]


def meeting_point(seeing: Sequence[tuple[Camera, Mask]]) -> Floats:
    """Find the point (3,) nearest to the rays through the silhouettes' centroids."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for camera, mask in seeing:
        rows, columns = np.nonzero(mask)
        ray = camera.rays(np.array([[columns.mean(), rows.mean()]])).directions[0]
        across = np.eye(3) - np.outer(ray, ray)
        normal += across
        right += across @ camera.centre
    return np.asarray(np.linalg.lstsq(normal, right, rcond=None)[0], float)
