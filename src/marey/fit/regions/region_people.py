"""Other people of a take, found and tracked by regions beside those who are already tracked."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np

from marey.arrays import Mask
from marey.body.articulation.pose import PosedBody
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.fit.progress import FrameProgress, no_progress
from marey.fit.regions.region_search import RegionImages, learned_areas
from marey.fit.regions.region_track import IMAGES_KEPT, ImagesOf, RegionTrack, RegionTracker
from marey.observations.correspondence import view_of

REACH_M = 0.1
"""Distance from the drawn body of a tracked person up to which a pixel may show it [m]. Chosen by hand: joints are 50
to 100 mm off after tracking by regions."""
LEAST_SCORE = 0.4
"""Least score of another person per visible area, relative to the first one. Chosen by hand: it is about 0.7 for the
others of `market` and `office`; where nobody else is present (`jacks`, `reach`, `walk`, `stealth`), nothing is visible
or no score is positive."""
LEAST_AREA = 0.1
"""Least visible area of another person, added over the cameras, in the mean of the frames [m2]. Chosen by hand: it is
0.28 in `office`, where one camera sees the whole person and another one sees it without feet."""
AREA_FRAMES = 12
"""Number of frames from which the visible area is measured. Chosen by hand."""
CLEAR_SCORE = 0.48
"""Least score, relative to the first person, of another one who is found before a background is learned. It is 0.78 to
1.05 for the second people of `market` and of the takes `walk` and `stealth` with two people, 0.61 for a third one who
does not move at all, 0.36 for the second person of `office`, who is shown in parts and misplaced, and at most 0.25 for
what is found where nobody is, in these takes and in five others."""
PROMISING_SCORE = 0.3
"""Least such score of upright bodies at the best places for postures to be searched there: it is 0.49 to 0.78 for these
people, and at most 0.16 for all else."""
PLACES_IN_VIEW = 4
"""`PlaceSettings.in_view` for other people: cut by the border of an image, they may still hide the followed person."""
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

    def __call__(self, frame: int) -> RegionImages:
        """Return the classes of the pixels of a frame.

        A pixel that may show another person is no evidence, but for those behind the followed one: there the pixel
        shows that the followed person is elsewhere as far as its colours differ.
        """
        return self._kept_images(frame)

    @cached_property
    def _kept_images(self) -> ImagesOf:
        return lru_cache(maxsize=IMAGES_KEPT)(self._without_people)

    def _without_people(self, frame: int) -> RegionImages:
        images = self.images_of(frame)
        for person in self.people:
            if frame in person.poses:
                images = self._beside(images, PosedBody(person.body, person.poses[frame]), frame)
        return images

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


def find_clear_people(
    tracker: RegionTracker, body: Body, first: RegionTrack, *, progress: FrameProgress = no_progress
) -> list[RegionTrack]:
    """Find and track the other people of a take whose colours alone distinguish them, before a background is learned.

    Whoever hardly moves would otherwise become a part of the background.

    Args:
        tracker: The tracker of the first person, without learned backgrounds.
        body: A body with few vertices.
        first: The first person.
        progress: Called with each frame that was tracked.

    Returns:
        The others; nobody if the first person has no positive score.
    """
    if first.mean_score <= 0:
        return []
    people = [first]
    while len(people) <= MOST_OTHERS:
        own = _tracker_beside(tracker, people)
        placed = own.placed(body, floor=first.floor)
        if placed is None or placed.mean_score < PROMISING_SCORE * first.mean_score:
            break
        found = _tracked(own, own.postured(placed), progress)
        if not found.poses or found.mean_score < CLEAR_SCORE * first.mean_score:
            break
        people.append(found)
    return people[1:]


def find_other_people(
    tracker: RegionTracker, body: Body, first: RegionTrack, clear: Sequence[RegionTrack] = (), *,
    progress: FrameProgress = no_progress,
) -> list[RegionTrack]:  # fmt: skip
    """Find and track the other people of a take.

    Args:
        tracker: The tracker of the first person, with learned backgrounds.
        body: A body with few vertices.
        first: The first person.
        clear: The others who were found before the backgrounds were learned; they are tracked again.
        progress: Called with each frame that was tracked.

    Returns:
        The others, as far as their scores are comparable to that of the first person.
    """
    people, floor = [first], first.floor
    least = LEAST_SCORE * first.mean_score / max(visible_area(tracker, first), LEAST_AREA)
    for before in clear:
        own = _tracker_beside(tracker, people)
        found = _tracked(own, before, progress)
        # No background speaks for whoever never moves, who is therefore compared with the score without one.
        if _is_person(own, found, 0.0) and found.mean_score >= LEAST_SCORE * before.mean_score:
            people.append(found)
    while len(people) <= MOST_OTHERS:
        own = _tracker_beside(tracker, people)
        started = own.start(body, floor=floor)
        if started is None or not _is_person(own, started, least):
            break
        found = _tracked(own, started, progress)
        if not _is_person(own, found, least):
            break
        people.append(found)
    return people[1:]


def _tracker_beside(tracker: RegionTracker, people: Sequence[RegionTrack]) -> RegionTracker:
    """Return the tracker of a further person beside tracked people, also at places that images show in part."""
    beside = ImagesBeside(tracker.images_of, tracker.search.cameras, tuple(people))
    places = replace(tracker.settings.places, in_view=PLACES_IN_VIEW)
    return replace(tracker, images_of=beside, settings=replace(tracker.settings, places=places))


def _tracked(tracker: RegionTracker, started: RegionTrack, progress: FrameProgress) -> RegionTrack:
    """Track a person from the frame with the best score; return the frames that show the person."""
    best = max(started.scores, key=lambda frame: started.scores[frame])
    only = replace(started, poses={best: started.poses[best]})
    return tracker.track(only, tracker.frames, progress=progress).shown(tracker.settings.least_share)


def _is_person(tracker: RegionTracker, track: RegionTrack, least: float) -> bool:
    """Return whether a track has enough visible area, and at least a score per visible area [nat]."""
    if not track.poses:
        return False
    area = visible_area(tracker, track)
    return area >= LEAST_AREA and track.mean_score >= least * area


def visible_area(tracker: RegionTracker, track: RegionTrack) -> float:
    """Return the visible area of a tracked person, added over the cameras, in the mean of some frames [m2]."""
    frames = list(track.poses)
    chosen = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, AREA_FRAMES).astype(int))]
    images = {frame: tracker.images_of(frame) for frame in chosen}
    areas = learned_areas(tracker.search, track.body, {frame: track.poses[frame] for frame in chosen}, images)
    return float(np.mean([own.sum() for own in areas.values()]))
