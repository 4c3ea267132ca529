"""Storage of the silhouettes that a run has found so far, frame by frame."""

from collections.abc import Sequence

import numpy as np

from marey.arrays import Mask
from marey.cameras.camera import Camera
from marey.images.silhouettes.interior import InteriorEdges
from marey.io.stages import Arrays, FrameLog
from marey.io.trial.masks import pack_mask, unpack_mask
from marey.pipelines.people.foreground import ForegroundPerson
from marey.pipelines.progress import Progress


class MaskStore:
    """Silhouettes of the frames of a take, and the edges inside them, on disk.

    Args:
        log: One record per frame: packed bits by camera and, if they were searched for, edges.
        first: The frame of the first record.
        cameras: The cameras, in the order of the records.
    """

    def __init__(self, log: FrameLog, first: int, cameras: Sequence[Camera]):
        self._log, self._first = log, first
        self._sizes = [camera.size for camera in cameras]
        self._last: tuple[int, Arrays] | None = None
        """The record that was read last: silhouettes and edges of a frame are read one after the other."""

    @property
    def frames(self) -> range:
        """The frames that are stored."""
        return range(self._first, self._first + len(self._log))

    def append(
        self, masks: Sequence[Mask], edges: Sequence[InteriorEdges] = (), hidden: Sequence[Mask] = (),
        energy: Sequence[float] = (),
    ) -> None:  # fmt: skip
        """Add the silhouettes of the next frame, the edges inside them, where they are hidden, and their energies."""
        packed = {f"camera_{c}": pack_mask(mask) for c, mask in enumerate(masks)}
        packed |= {f"hidden_{c}": pack_mask(mask) for c, mask in enumerate(hidden)}
        packed |= {"energy": np.array(energy)} if len(energy) else {}
        self._log.append(packed | {f"edges_{c}": _packed_edges(found) for c, found in enumerate(edges)})

    def keep(self, other: "MaskStore") -> None:
        """Add what another store of the same cameras and first frame holds of the next frame."""
        self._log.append(other._log[len(self._log)])

    def _record(self, frame: int) -> Arrays:
        last = self._last
        if last is None or last[0] != frame:
            last = self._last = frame, self._log[frame - self._first]
        return last[1]

    def known(self, frame: int) -> list[Mask] | None:
        """Return the silhouettes of a frame, or None if it is not stored."""
        return self(frame) if frame in self.frames else None

    def __call__(self, frame: int) -> list[Mask]:
        """Return the silhouettes of a frame, one per camera."""
        record = self._record(frame)
        return [unpack_mask(record[f"camera_{c}"], (h, w)) for c, (w, h) in enumerate(self._sizes)]

    def of_camera(self, frame: int, camera: int) -> Mask:
        """Return the silhouette of a frame in one camera, given by its number."""
        width, height = self._sizes[camera]
        return unpack_mask(self._record(frame)[f"camera_{camera}"], (height, width))

    def edges(self, frame: int) -> list[InteriorEdges] | None:
        """Return the edges inside the silhouettes, one set per camera; None if they were not searched for."""
        record = self._record(frame)
        found = [_unpacked_edges(record[f"edges_{c}"]) for c in range(len(self._sizes)) if f"edges_{c}" in record]
        return found or None

    def energy(self, frame: int) -> float:
        """Return the sum of the energies of a frame's silhouettes [nat]; NaN if they are not known."""
        record = self._record(frame)
        return float(record["energy"].sum()) if "energy" in record else float("nan")

    def known_hidden(self, frame: int) -> list[Mask] | None:
        """Return where something hides the person in a frame; None if it was not searched for or is not stored."""
        return self.hidden(frame) if frame in self.frames else None

    def hidden(self, frame: int) -> list[Mask] | None:
        """Return where something hides the person, one mask per camera; None if it was not searched for."""
        record = self._record(frame)
        if "hidden_0" not in record:
            return None
        return [unpack_mask(record[f"hidden_{c}"], (h, w)) for c, (w, h) in enumerate(self._sizes)]


def separated(
    store: MaskStore, cameras: Sequence[Camera], person: ForegroundPerson, own: MaskStore, progress: Progress
) -> MaskStore:
    """Write the silhouettes of one of several people, and where the others hide it, to a store, and return it."""
    with progress.stage("Silhouettes of the person", len(store.frames), done=len(own.frames)) as step:
        for frame in store.frames[len(own.frames) :]:
            masks, hidden = person.silhouettes(frame, cameras, store(frame))
            own.append(masks, hidden=hidden)
            step()
    return own


def _packed_edges(edges: InteriorEdges) -> np.ndarray:
    """Pack edges as rows x, y, normal, limb (n, 5) in single precision, which is far finer than their error."""
    return np.column_stack([edges.pixels, edges.inward, edges.limb]).astype(np.float32)


def _unpacked_edges(rows: np.ndarray) -> InteriorEdges:
    pixels, inward = (np.ascontiguousarray(part, float) for part in (rows[:, :2], rows[:, 2:4]))
    return InteriorEdges(pixels=pixels, inward=inward, limb=rows[:, 4].astype(np.int64))
