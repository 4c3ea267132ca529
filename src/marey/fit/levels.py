"""The silhouettes of a frame at one size of the pictures, shrunken for speed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.cameras.camera import Camera
from marey.observations.correspondence import Sighting


@dataclass(frozen=True, eq=False)
class Level:
    """One frame's silhouettes at one size of the pictures."""

    cameras: tuple[Camera, ...]
    masks: tuple[Mask, ...]
    sightings: tuple[Sighting, ...]

    @staticmethod
    def of(cameras: Sequence[Camera], masks: Sequence[Mask], factor: float) -> "Level":
        """Shrink silhouettes and cameras by a factor."""
        small = tuple(camera.scaled(factor) for camera in cameras)
        return Level.at_size(small, [shrink(mask, camera.size) for mask, camera in zip(masks, small, strict=True)])

    @staticmethod
    def at_size(cameras: Sequence[Camera], masks: Sequence[Mask]) -> "Level":
        """Trace silhouettes that have their cameras' size already."""
        sightings = tuple(Sighting.of(camera, mask) for camera, mask in zip(cameras, masks, strict=True))
        return Level(tuple(cameras), tuple(masks), sightings)

    def packed(self) -> tuple[Floats, Integers, Integers, Mask]:
        """Give cameras (C, P), widths, heights and masks padded to one size, for the kernels."""
        widths = np.array([camera.width for camera in self.cameras])
        heights = np.array([camera.height for camera in self.cameras])
        padded = np.zeros((len(self.cameras), heights.max(), widths.max()), bool)
        for c, mask in enumerate(self.masks):
            padded[c, : heights[c], : widths[c]] = mask
        return np.array([camera.packed for camera in self.cameras]), widths, heights, padded


def shrink(mask: Mask, size: tuple[int, int]) -> Mask:
    """Shrink a silhouette: a pixel is inside where most of what it stands for is."""
    if (mask.shape[1], mask.shape[0]) == size:
        return mask
    share = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    # Half pixels are many at a factor of two: all left out, they would make the person thinner by a quarter of a pixel.
    row, column = np.indices(share.shape)
    return (share > 0.5) | ((share == 0.5) & ((row + column) % 2 == 0))


def level_factor(masks: Sequence[Mask], height: float) -> float:
    """Choose the power of two by which silhouettes shrink to about a height [px]."""
    tallest = max([int(np.count_nonzero(mask.any(1))) for mask in masks] + [1])
    return min(1.0, float(2.0 ** np.round(np.log2(height / tallest))))


class FrameLevels:
    """The frames of a take at one size, made when they are asked for; the last few are kept.

    Args:
        cameras: of the whole pictures.
        masks_of: gives the silhouettes (height, width) of a frame, one a camera.
        factor: new size over old size.
    """

    def __init__(self, cameras: Sequence[Camera], masks_of: Callable[[int], Sequence[Mask]], factor: float):
        self.factor = factor
        self._small = tuple(camera.scaled(factor) for camera in cameras)
        self._masks_of = masks_of
        self.at = lru_cache(maxsize=48)(self._at)

    def _at(self, frame: int) -> Level:
        shrunk = [shrink(m, c.size) for m, c in zip(self._masks_of(frame), self._small, strict=True)]
        return Level.at_size(self._small, shrunk)
