"""Things that hide the person in a take, found from its silhouettes and its fitted body."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.fit.solver.picture_times import PictureTimes
from marey.fit.solver.threads import map_in_threads
from marey.images.silhouettes.occluders import CoverCounts, OccluderSettings, StaticOccluder, divided
from marey.io.stages import Arrays
from marey.observations.correspondence import view_of

LOOKED_FRAMES, LOOKED_PX = 60, 480
"""Largest number of frames from which the things are found, evenly spaced, and largest height of their images [px],
which bounds the memory to some tens of megabytes per camera. Chosen by hand."""
BORDER_M = 0.03
"""Error of the body's outline: pixels nearer to it are not counted, and a point so deep below the skin is looked for in
the other cameras [m]. Chosen by hand."""
CLASS_M, MOST_CLASSES = 0.25, 10
"""Least width of the classes of distance [m], and their largest number. Chosen by hand."""
WITNESSES = 2
"""Number of other cameras that must show a part of the body, if there are as many. Chosen by hand."""

HiddenByFrame = Callable[[int], Sequence[Mask] | None]
"""Returns where something hides the person in a frame, one mask (height, width) per camera; None if it is not known."""
MasksByFrame = Callable[[int], Sequence[Mask]]
"""Returns the silhouettes (height, width) of a frame, one per camera."""


@dataclass(frozen=True, eq=False)
class BodyTake:
    """A body in its poses, and the cameras that see it."""

    cameras: Sequence[Camera]
    body: Body
    poses: Mapping[int, Pose]
    times: PictureTimes | None = None
    """When the cameras have taken their pictures; None if that is at the instants of the frames."""

    def posed(self, frame: int) -> list[PosedBody]:
        """Return the body of a frame at the instant of each camera's picture."""
        now = PosedBody(self.body, self.poses[frame])
        return [now] * len(self.cameras) if self.times is None else self.times.posed(frame, now, self.poses)

    def looked(self) -> list[int]:
        """Return frames that are evenly spaced."""
        known = sorted(self.poses)
        return [known[i] for i in np.unique(np.linspace(0, len(known) - 1, min(LOOKED_FRAMES, len(known))).astype(int))]


@dataclass(frozen=True, eq=False)
class Occluders:
    """What stands in front of the person in each camera through the whole take."""

    things: Sequence[StaticOccluder]
    """One per camera, for images of any size."""

    @property
    def any(self) -> bool:
        """Whether there is something in front in any camera."""
        return any(thing.share > 0 for thing in self.things)

    def behind(self, posed: Sequence[PosedBody], cameras: Sequence[Camera]) -> list[Mask]:
        """Return where something stands in front of a body, one mask (height, width) per camera.

        Args:
            posed: The body at the instant of each camera's picture.
            cameras: The cameras.
        """
        return [
            thing.resized(camera.size).hides(distances_of(own, camera))
            for thing, own, camera in zip(self.things, posed, cameras, strict=True)
        ]

    def hidden_in(self, take: BodyTake, masks_of: MasksByFrame) -> HiddenByFrame:
        """Return a function that finds where the person of a frame is hidden, from silhouettes without the things."""

        def hidden(frame: int) -> list[Mask] | None:
            if frame not in take.poses:
                return None
            behind = self.behind(take.posed(frame), take.cameras)
            return [divided(mask, each)[1] for mask, each in zip(masks_of(frame), behind, strict=True)]

        return hidden

    def packed(self) -> Arrays:
        """Return the things as arrays."""
        return {f"camera_{c}": thing.nearest_m for c, thing in enumerate(self.things)}

    @staticmethod
    def unpacked(arrays: Arrays) -> "Occluders":
        """Return the things from their arrays."""
        return Occluders([StaticOccluder(arrays[f"camera_{c}"]) for c in range(len(arrays))])


def find_occluders(
    take: BodyTake, masks_of: MasksByFrame, unknown_of: HiddenByFrame, settings: OccluderSettings
) -> Occluders:  # fmt: skip
    """Find what hides the person through the whole take, in each camera.

    Args:
        take: The body in its poses.
        masks_of: The silhouettes.
        unknown_of: Returns where an image says nothing of the person, one mask (height, width) per camera; None if it
            does everywhere.
        settings: What counts as a thing.

    Returns:
        The things, in images of at most `LOOKED_PX` rows.
    """
    frames = take.looked()
    cameras = [camera.scaled(min(1.0, LOOKED_PX / camera.height)) for camera in take.cameras]
    counts = [CoverCounts(camera.size, _edges(take, frames, camera)) for camera in cameras]

    def covered(frame: int) -> list[tuple[int, Floats, Mask, Mask]]:
        """Return for each camera that shows the person its number, `_covered`, and the silhouette."""
        posed, masks = take.posed(frame), _resized(masks_of(frame), cameras)
        unknown = _resized(unknown_of(frame) or [np.zeros_like(mask) for mask in masks], cameras)
        states = np.array([_shown(*each) for each in zip(posed, cameras, masks, unknown, strict=True)])
        found = []
        for c, (own, camera, mask) in enumerate(zip(posed, cameras, masks, strict=True)):
            if not mask.any():
                continue
            others = np.delete(states, c, axis=0)
            inside, against = (others == 1).sum(0), (others == 0).sum(0)
            sure = (inside >= min(WITNESSES, len(others))) & (inside > against)
            distance, certain = _covered(own, camera, sure)
            distance[unknown[c]] = np.inf
            found.append((c, distance, certain, mask))
        return found

    for found in map_in_threads(covered, frames):
        for c, distance, certain, mask in found:
            counts[c].add(distance, certain, mask)
    return Occluders([each.occluder(settings) for each in counts])


def _resized(masks: Sequence[Mask], cameras: Sequence[Camera]) -> list[Mask]:
    """Return masks in the sizes of the images of some cameras."""
    return [
        mask if mask.shape == camera.size[::-1]
        else cv2.resize(mask.view(np.uint8), camera.size, interpolation=cv2.INTER_NEAREST) > 0
        for mask, camera in zip(masks, cameras, strict=True)
    ]  # fmt: skip


def _edges(take: BodyTake, frames: Sequence[int], camera: Camera) -> Floats:
    """Return the limits of the classes of distance in a camera [m]."""
    ends = [take.poses[frame].translation for frame in frames]
    away = np.linalg.norm(np.array(ends) - camera.centre, axis=1)
    low, high = float(away.min()) - CLASS_M, float(away.max()) + CLASS_M
    return np.linspace(low, high, 1 + int(np.clip((high - low) / CLASS_M, 1, MOST_CLASSES)))


def _shown(posed: PosedBody, camera: Camera, mask: Mask, unknown: Mask) -> Integers:
    """Return what a camera shows of each face (T,): 1 the silhouette, 0 something else, -1 nothing."""
    corners = posed.vertices[posed.body.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    pixels = camera.project(corners.mean(1) - BORDER_M * normal)
    with np.errstate(invalid="ignore"):
        shown = camera.sees(pixels)
    state: Integers = np.full(len(pixels), -1, np.int8)
    column, row = np.rint(pixels[shown]).astype(int).T
    column, row = np.clip(column, 0, camera.width - 1), np.clip(row, 0, camera.height - 1)
    state[shown] = np.where(unknown[row, column], -1, mask[row, column])
    return state


def _covered(posed: PosedBody, camera: Camera, sure: Mask) -> tuple[Floats, Mask]:
    """Return the distance of the body at each pixel (height, width) [m], and where it covers the pixel for certain.

    Args:
        posed: The body.
        camera: The camera.
        sure: (T,) true for faces that other cameras show.

    Returns:
        The distance, infinite where the body is not; and the pixels that are neither near its border nor on a face of
        which the other cameras are not sure.
    """
    view, distance = view_of(posed, camera), distances_of(posed, camera)
    drawn = view.mask()
    distance[~drawn] = np.inf
    reach = BORDER_M * float(camera.matrix[0, 0] / np.linalg.norm(posed.segment_origin.mean(axis=0) - camera.centre))
    certain = cv2.distanceTransform(drawn.view(np.uint8), cv2.DIST_L2, 3) > reach
    x, y = view.corner
    height, width = view.face.shape
    certain[y : y + height, x : x + width] &= sure[view.face]
    return distance, certain


def distances_of(posed: PosedBody, camera: Camera) -> Floats:
    """Return the distance of the body at each pixel (height, width) [m]; its mean one where it is not."""
    view = view_of(posed, camera)
    usual = float(np.linalg.norm(posed.segment_origin.mean(axis=0) - camera.centre))
    distance = np.full((camera.height, camera.width), usual, np.float32)
    x, y = view.corner
    height, width = view.face.shape
    covered = view.face >= 0
    distance[y : y + height, x : x + width][covered] = 1 / view.inverse_depth[covered]
    return distance
