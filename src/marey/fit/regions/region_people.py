"""Other people of a take, found and tracked by regions beside those who are already tracked."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from marey.arrays import Mask
from marey.body.articulation.pose import PosedBody
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.fit.progress import FrameProgress, no_progress
from marey.fit.regions.region_search import RegionImages
from marey.fit.regions.region_track import ImagesOf, RegionTrack, RegionTracker
from marey.observations.correspondence import view_of

REACH_M = 0.1
"""Distance from the drawn body of a tracked person up to which a pixel may show it [m]. Chosen by hand: joints are 50
to 100 mm off after tracking by regions."""
LEAST_SCORE = 0.4
"""Least mean score of another person relative to the first one. Chosen by hand: it is 0.65 for the other person of
`market`, and below 0 where nobody else is present (`jacks`)."""
MOST_OTHERS = 4
"""Largest number of other people that are searched for. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class ImagesBeside:
    """The images of a take in which tracked people are no evidence for another person."""

    images_of: ImagesOf
    """Returns the classes of the pixels of a frame."""
    cameras: tuple[Camera, ...]
    """C cameras of the reduced images."""
    people: Sequence[RegionTrack]
    """The tracked people."""
    followed: RegionTrack | None = None
    """The person for whom the images are evidence, whose place decides who is nearer to a camera; None if it is not
    known."""
    _known: dict[int, RegionImages] = field(default_factory=dict, repr=False)

    def __call__(self, frame: int) -> RegionImages:
        """Return the classes of the pixels of a frame.

        A pixel that may show another person is no evidence, but for those behind the followed one: there the pixel
        shows that the followed person is elsewhere as far as its colours differ.
        """
        if frame not in self._known:
            images = self.images_of(frame)
            for person in self.people:
                if frame in person.poses:
                    images = self._beside(images, PosedBody(person.body, person.poses[frame]), frame)
            self._known[frame] = images
        return self._known[frame]

    def _beside(self, images: RegionImages, other: PosedBody, frame: int) -> RegionImages:
        covered = np.zeros(images.words.shape, bool)
        followed = self.followed
        own = None
        if followed is not None:
            nearest = min(followed.poses, key=lambda known: abs(known - frame))
            own = PosedBody(followed.body, followed.poses[nearest]).segment_origin.mean(axis=0)
        evidence = np.array(images.evidence)
        for c, camera in enumerate(self.cameras):
            drawn = may_show(other, camera)
            middle = other.segment_origin.mean(axis=0)
            if own is None or np.linalg.norm(middle - camera.centre) < np.linalg.norm(own - camera.centre):
                covered[c, : camera.height, : camera.width] = drawn
            else:
                part = evidence[c, : camera.height, : camera.width]
                part[drawn] = np.minimum(part[drawn], 0.0)
        return RegionImages(images.words, evidence).without(covered)


def may_show(posed: PosedBody, camera: Camera) -> Mask:
    """Return the pixels (height, width) of an image that may show a body: its own, and those up to `REACH_M` beside."""
    away = max(float(np.linalg.norm(posed.segment_origin.mean(axis=0) - camera.centre)), REACH_M)
    reach = int(np.ceil(REACH_M * camera.matrix[0, 0] / away))
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return np.asarray(cv2.dilate(view_of(posed, camera).mask().view(np.uint8), disk) > 0)


def find_other_people(
    tracker: RegionTracker, body: Body, first: RegionTrack, *, progress: FrameProgress = no_progress
) -> list[RegionTrack]:
    """Find and track the other people of a take.

    Args:
        tracker: The tracker of the first person, with learned backgrounds.
        body: A body with few vertices.
        first: The first person.
        progress: Called with each frame that was tracked.

    Returns:
        The others, as far as their scores are comparable to that of the first person.
    """
    people, least = [first], LEAST_SCORE * first.mean_score
    for _ in range(MOST_OTHERS):
        own = replace(tracker, images_of=ImagesBeside(tracker.images_of, tracker.search.cameras, people))
        started = own.start(body)
        if started is None or started.mean_score < least:
            break
        best = max(started.poses, key=lambda frame: started.scores[frame])
        found = own.track(
            replace(started, poses={best: started.poses[best]}), own.frames, progress=progress
        ).shown(own.settings.least_share)  # fmt: skip
        if found.mean_score < least:
            break
        people.append(found)
    return people[1:]
