"""Silhouettes that a run has found so far, kept frame by frame."""

from collections.abc import Sequence

import numpy as np

from marey.arrays import Mask
from marey.cameras.camera import Camera
from marey.images.silhouettes.interior import InteriorEdges
from marey.io.stages import FrameLog
from marey.io.trial.masks import pack_mask, unpack_mask


class MaskStore:
    """Silhouettes of a take's frames, and the edges inside of them, on disk.

    Args:
        log: One record a frame, packed bits by camera, and edges where pictures were looked at for them.
        first: The number of the frame in the log's first record.
        cameras: In the order of the records.
    """

    def __init__(self, log: FrameLog, first: int, cameras: Sequence[Camera]):
        self._log, self._first = log, first
        self._sizes = [camera.size for camera in cameras]

    @property
    def frames(self) -> range:
        """The frames that are there."""
        return range(self._first, self._first + len(self._log))

    def append(self, masks: Sequence[Mask], edges: Sequence[InteriorEdges] = ()) -> None:
        """Add the next frame's silhouettes, and the edges inside of them."""
        packed = {f"camera_{c}": pack_mask(mask) for c, mask in enumerate(masks)}
        self._log.append(packed | {f"edges_{c}": _packed_edges(found) for c, found in enumerate(edges)})

    def known(self, frame: int) -> list[Mask] | None:
        """Give a frame's silhouettes, or None where there are none."""
        return self(frame) if frame in self.frames else None

    def __call__(self, frame: int) -> list[Mask]:
        """Give a frame's silhouettes, one a camera."""
        record = self._log[frame - self._first]
        return [unpack_mask(record[f"camera_{c}"], (h, w)) for c, (w, h) in enumerate(self._sizes)]

    def edges(self, frame: int) -> list[InteriorEdges] | None:
        """Give the edges inside of a frame's silhouettes, one set a camera; None where nobody looked for them."""
        record = self._log[frame - self._first]
        found = [_unpacked_edges(record[f"edges_{c}"]) for c in range(len(self._sizes)) if f"edges_{c}" in record]
        return found or None


def _packed_edges(edges: InteriorEdges) -> np.ndarray:
    """Pack edges as rows x, y, normal, limb (n, 5): a hundredth of a pixel is more than they are known to."""
    return np.column_stack([edges.pixels, edges.inward, edges.limb]).astype(np.float32)


def _unpacked_edges(rows: np.ndarray) -> InteriorEdges:
    pixels, inward = (np.ascontiguousarray(part, float) for part in (rows[:, :2], rows[:, 2:4]))
    return InteriorEdges(pixels=pixels, inward=inward, limb=rows[:, 4].astype(np.int64))
