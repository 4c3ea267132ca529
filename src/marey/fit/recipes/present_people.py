"""The people who are present in a take, and the one that a user means."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.fit.recipes.seen_people import PersonTrack
from marey.fit.search.hull_people import HullTrack, hull_height

CLICK_M = 0.35
"""Largest distance of a click from the nearest known point of a person, at the distance of the person [m]. Chosen by
hand: the middle of the trunk is about 0.25 m from shoulders and hips."""
PLACE_M = 0.6
"""Largest horizontal distance of a named place from the middle of a person [m]. Chosen by hand."""
LEAST_IN_BOX = 0.5
"""Least share of the known points of a person that a box about it must contain. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class PresentPerson:
    """One person who is present in a take."""

    points: Mapping[int, Floats]
    """(n, 3) known points of the person by frame [m]."""
    height_m: float = float("nan")
    """Approximate height [m]; NaN if it is not known."""

    @property
    def frames(self) -> list[int]:
        """The frames in which the person was found."""
        return sorted(self.points)

    def middle(self, frame: int) -> Floats:
        """Return the median (3,) of the points of a frame [m]."""
        return np.asarray(np.median(self.points[frame], axis=0))

    def nearest_frame(self, frame: int) -> int:
        """Return the frame nearest to another one in which the person was found."""
        return min(self.points, key=lambda known: abs(known - frame))

    def pixels(self, camera: Camera, frame: int) -> Floats:
        """Return the images (n, 2) of the points that a camera has in view [px]."""
        seen = camera.project(self.points[frame])
        return np.asarray(seen[camera.sees(seen)])


def person_at_pixel(people: Sequence[PresentPerson], camera: Camera, pixel: Floats, frame: int) -> int | None:
    """Return the index of the person whose points are nearest to a pixel; None if nobody is near it.

    Args:
        people: The people.
        camera: The camera.
        pixel: (2,) [px].
        frame: The frame.
    """
    found, least = None, CLICK_M
    for i, person in enumerate(people):
        if frame in person.points:
            seen = person.pixels(camera, frame)
            if len(seen):
                away = float(np.linalg.norm(person.middle(frame) - camera.centre))
                apart = float(np.linalg.norm(seen - pixel, axis=1).min()) * away / float(camera.matrix[0, 0])
                found, least = (i, apart) if apart < least else (found, least)
    return found


def person_in_box(people: Sequence[PresentPerson], camera: Camera, box: Floats, frame: int) -> int | None:
    """Return the index of the person who fills a box best; None if the box contains at most half of anybody.

    Args:
        people: The people.
        camera: The camera.
        box: (4,) left, top, right and bottom [px].
        frame: The frame.
    """
    found, best = None, 0.0
    for i, person in enumerate(people):
        seen = person.pixels(camera, frame) if frame in person.points else np.zeros((0, 2))
        if not len(seen):
            continue
        inside = ((seen >= box[:2]) & (seen <= box[2:])).all(axis=1)
        low, high = seen.min(0), seen.max(0)
        common = np.prod(np.maximum(np.minimum(high, box[2:]) - np.maximum(low, box[:2]), 0))
        overlap = float(common / (np.prod(high - low) + np.prod(box[2:] - box[:2]) - common + 1e-9))
        if inside.mean() > LEAST_IN_BOX and overlap > best:
            found, best = i, overlap
    return found


def person_at_place(people: Sequence[PresentPerson], place: Floats, frame: int | None = None) -> int | None:
    """Return the index of the person nearest to a place of the world; None if nobody is near it.

    Args:
        people: The people.
        place: (3,) [m], Z up.
        frame: The frame; None for any frame.
    """
    found, least = None, PLACE_M
    for i, person in enumerate(people):
        frames = person.frames if frame is None else [frame] if frame in person.points else []
        for each in frames:
            apart = float(np.linalg.norm(person.middle(each)[:2] - place[:2]))
            found, least = (i, apart) if apart < least else (found, least)
    return found


EARS_OVER_ANKLES = 0.897
"""Height of the ears above the ankles relative to the stature, of adults [Winter2009]."""


def person_of_track(track: PersonTrack, joint_names: Sequence[str]) -> PresentPerson:
    """Return a person whose joints were detected; the height follows from ears and ankles, upright in most frames.

    Args:
        track: The joints in space.
        joint_names: Names of the joints.
    """
    points = {seen.frame: seen.points[np.isfinite(seen.points).all(1)] for seen in track.seen}
    head = joint_names.index("head")
    ankles = [joint_names.index(f"{side}_ankle") for side in ("left", "right")]
    tall = [seen.points[head, 2] - np.nanmin(np.append(seen.points[ankles, 2], np.inf)) for seen in track.seen]
    known = [height for height in tall if np.isfinite(height)]
    return PresentPerson(points, float(np.quantile(known, 0.8)) / EARS_OVER_ANKLES if known else float("nan"))


def person_of_hull(track: HullTrack, cell_m: float) -> PresentPerson:
    """Return a person in the foreground; the height is the vertical extent, larger with raised arms.

    Args:
        track: The cells of the person.
        cell_m: Their edge [m].
    """
    return PresentPerson(track.cells, hull_height(track, cell_m))
