"""Consecutive pictures in which the board does not move, joined to one."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Integers
from marey.calibration.boards.corners import BoardSighting, CornerSet

_STILL_SD = 1.5
"""Root mean square shift of common corners up to which the board is still, in standard deviations; by hand."""
_STILL_PX = 0.15
"""The same in pixels, whichever is larger: errors of corners exceed their standard deviations. Chosen by hand."""
_LEAST_COMMON = 4
"""Least number of corners that two pictures must share to be compared; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class StillGroups:
    """Corners in which runs of still pictures are joined."""

    corners: CornerSet
    """With as many instants as before; those of a run carry the number of its first picture."""
    first: Integers
    """(F,) for each picture the first picture of its run; itself where the board moves or is not seen."""

    def runs(self) -> list[tuple[int, int]]:
        """List runs of several pictures as pairs of the first and the last picture."""
        starts, counts = np.unique(self.first, return_counts=True)
        return [(int(a), int(a + n - 1)) for a, n in zip(starts, counts, strict=True) if n > 1]


def join_still(corners: CornerSet) -> StillGroups:
    """Join consecutive pictures of a video in which the board does not move.

    The pixels of a corner are averaged, its covariance is kept: the errors of still pictures are hardly independent,
    since a video repeats what does not change.

    Args:
        corners: All corners; consecutive instants are consecutive pictures.

    Returns:
        The joined corners.
    """
    first = np.arange(len(corners.pictures))
    table = _by_picture(corners)
    for picture in range(1, len(first)):
        start = first[picture - 1]
        if picture in table and start in table and _is_still(corners, table[start], table[picture]):
            first[picture] = start
    if len(np.unique(first)) == len(first):
        return StillGroups(corners=corners, first=first)
    return StillGroups(corners=_joined(corners, first), first=first)


def _by_picture(corners: CornerSet) -> dict[int, dict[tuple[int, int], int]]:
    """Return for each picture the row of each camera and corner."""
    table: dict[int, dict[tuple[int, int], int]] = {}
    keys = zip(corners.picture.tolist(), corners.camera.tolist(), corners.corner.tolist(), strict=True)
    for row, (picture, camera, corner) in enumerate(keys):
        table.setdefault(picture, {})[camera, corner] = row
    return table


def _is_still(corners: CornerSet, before: dict[tuple[int, int], int], after: dict[tuple[int, int], int]) -> bool:
    """Return whether the corners that two pictures share lie at the same pixels in every camera."""
    common = sorted(before.keys() & after.keys())
    if len(common) < _LEAST_COMMON:
        return False
    a, b = np.array([before[key] for key in common]), np.array([after[key] for key in common])
    shift = corners.pixels[b] - corners.pixels[a]
    spread = corners.covariance[a] + corners.covariance[b]
    scaled = np.einsum("ni,nij,nj->n", shift, np.linalg.inv(spread), shift)
    square = np.minimum(scaled, np.square(shift / _STILL_PX).sum(axis=1) * _STILL_SD**2)
    of_camera = np.array([camera for camera, _ in common])
    return all(np.mean(square[of_camera == camera]) < 2 * _STILL_SD**2 for camera in np.unique(of_camera))


def _joined(corners: CornerSet, first: Integers) -> CornerSet:
    keys = np.stack([first[corners.picture], corners.camera, corners.corner], axis=-1)
    unique, inverse = np.unique(keys, axis=0, return_inverse=True)
    inverse = np.ravel(inverse)
    count = np.bincount(inverse).astype(float)
    pixels = np.stack([np.bincount(inverse, corners.pixels[:, k]) / count for k in range(2)], axis=-1)
    spread = np.zeros((len(unique), 2, 2))
    np.add.at(spread, inverse, corners.covariance)
    spread /= count[:, None, None]
    rows = []
    views, starts = np.unique(unique[:, :2], axis=0, return_index=True)
    for (picture, camera), part in zip(views, np.split(np.arange(len(unique)), starts[1:]), strict=True):
        found = BoardSighting(corner=unique[part, 2], pixels=pixels[part], covariance=spread[part])
        rows.append((int(picture), int(camera), found))
    return CornerSet.gather(corners.cameras, corners.sizes, corners.pictures, rows)
