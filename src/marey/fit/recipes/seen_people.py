"""Association of the persons that a detector found in several images, and the choice of the person to follow."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations, product

import numpy as np
from scipy.optimize import linear_sum_assignment

from marey.arrays import Floats, Integers, Mask
from marey.cameras.camera import Camera
from marey.cameras.triangulate import triangulate


@dataclass(frozen=True, kw_only=True)
class AssociationSettings:
    """Settings of the association of detected persons. Chosen by hand; other values were not measured."""

    tolerance_m: float = 0.08
    """Distance between a point in space and the ray of a detected joint up to which they agree [m]."""
    least_joints: int = 5
    """Number of joints that must agree in an image for the person in it to be the same one."""
    least_confidence: float = 0.3
    """Least confidence of a joint that takes part in the association."""
    least_apart_m: float = 0.15
    """Median distance of the joints of two people below which the second one is a double detection of the first [m]."""
    speed: float = 4.0
    """Largest speed of a person [m/s]."""
    longest_gap: float = 2.0
    """Longest time without detections after which a person is the same one if it appears at the same place [s]."""
    slack_m: float = 0.3
    """Distance that is added to the one which a person may have moved: the set of detected joints changes [m]."""


@dataclass(frozen=True, eq=False)
class SeenPerson:
    """One person in one frame, seen by two cameras or more."""

    frame: int
    persons: Integers
    """(C,) number of the person in each camera's image; -1 where it was not found."""
    points: Floats
    """(J, 3) the joints in space; NaN where they were not found in two images [m]."""
    agreeing: Mask
    """(C, J) true for the detected joints that agree with the points."""

    @property
    def centre(self) -> Floats:
        """Median (3,) of the joints in space [m]."""
        return np.asarray(np.nanmedian(self.points, axis=0))


@dataclass(eq=False)
class PersonTrack:
    """The frames of one person."""

    seen: list[SeenPerson] = field(default_factory=list)

    @property
    def support(self) -> int:
        """Number of detected joints that agree, over all frames."""
        return sum(int(np.count_nonzero(person.agreeing)) for person in self.seen)

    def persons(self, frame: int, count: int) -> Integers:
        """Return the number (C,) of the person in the images of a frame by `count` cameras; -1 where not found."""
        return next((person.persons for person in self.seen if person.frame == frame), np.full(count, -1))

    def with_seen(self, person: SeenPerson) -> "PersonTrack":
        """Return the track with another observation of a frame, which replaces the one of the track."""
        others = [each for each in self.seen if each.frame != person.frame]
        return PersonTrack(sorted([*others, person], key=lambda each: each.frame))


def find_people(
    cameras: Sequence[Camera], pixels: Floats, confidence: Floats, *, rate: float,
    settings: AssociationSettings | None = None,
) -> list[PersonTrack]:  # fmt: skip
    """Find the persons of a take: those of all images that agree in space, linked over time.

    Args:
        cameras: C cameras.
        pixels: (F, C, P, J, 2) of at most P persons per image [px]; NaN where a joint was not found.
        confidence: (F, C, P, J) from 0 to 1.
        rate: Frame rate [Hz].
        settings: Settings of the association.

    Returns:
        The persons; the first one has the largest number of agreeing joints, that is, it was longest and most
        completely in the common volume of the cameras.
    """
    settings = settings or AssociationSettings()
    used = np.where((confidence >= settings.least_confidence)[..., None], pixels, np.nan)
    pairs = _agreements(cameras, used, settings)
    tracks: list[PersonTrack] = []
    for frame in range(len(used)):
        _link(tracks, _people_of_frame(frame, cameras, used[frame], pairs, settings), rate, settings)
    return sorted(tracks, key=lambda track: -track.support)


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two persons in two images, taken for the same one, in all frames."""

    scores: Floats
    """(F,) number of agreeing joints in all images, less a small cost of their distances."""
    persons: Integers
    """(F, C) number of the person in each image that agrees best; -1 where none does."""


def _agreements(cameras: Sequence[Camera], used: Floats, settings: AssociationSettings) -> list[_Pair]:
    """Triangulate every pair of persons in two images, and count what agrees with it in all images."""
    frames, count, most = used.shape[:3]
    pairs = []
    for (i, j), (a, b) in product(combinations(range(count), 2), product(range(most), repeat=2)):
        two = np.stack([used[:, i, a], used[:, j, b]]).reshape(2, -1, 2)
        if not np.isfinite(two).all(axis=(0, 2)).any():
            continue
        points = triangulate([cameras[i], cameras[j]], two, sigma_px=1.0).points.reshape(frames, -1, 3)
        persons, scores = np.full((frames, count), -1), np.zeros(frames)
        for c, camera in enumerate(cameras):
            near = _nearness(camera, points, used[:, c], settings.tolerance_m)
            agreeing = np.count_nonzero(near >= 0, axis=2)
            value = agreeing + 0.1 * np.maximum(near, 0).sum(axis=2)
            # The two images of the pair must support the pair's own persons.
            best = np.full(frames, {i: a, j: b}[c]) if c in (i, j) else value.argmax(axis=1)
            enough = agreeing[np.arange(frames), best] >= settings.least_joints
            persons[enough, c] = best[enough]
            scores += np.where(enough, value[np.arange(frames), best], 0.0)
        whole = (persons[:, i] >= 0) & (persons[:, j] >= 0)
        pairs.append(_Pair(np.where(whole, scores, -1.0), persons))
    return pairs


def _nearness(camera: Camera, points: Floats, seen: Floats, tolerance_m: float) -> Floats:
    """Return how near points lie to detected joints: 1 for no distance, 0 at the tolerance, below 0 beyond it.

    Args:
        camera: The camera.
        points: (F, J, 3) [m].
        seen: (F, P, J, 2) [px].
        tolerance_m: Tolerance at the distance of the points [m].

    Returns:
        (F, P, J), -1 where either is not known.
    """
    flat = points.reshape(-1, 3)
    known = np.isfinite(flat[:, 0])
    projected = np.full((len(flat), 2), np.nan)
    if known.any():
        projected[known] = camera.project(flat[known])
    distance = np.linalg.norm(flat - camera.centre, axis=1)
    tolerance = (tolerance_m * camera.matrix[0, 0] / distance).reshape(points.shape[:2])
    apart = np.linalg.norm(seen - projected.reshape(*points.shape[:2], 2)[:, None], axis=-1)
    return np.where(np.isfinite(apart), np.maximum(1.0 - apart / tolerance[:, None], -1.0), -1.0)


def _people_of_frame(
    frame: int, cameras: Sequence[Camera], used: Floats, pairs: Sequence[_Pair], settings: AssociationSettings
) -> list[SeenPerson]:
    """Choose persons in the order of their agreement; each detection belongs to one person at most."""
    taken: set[tuple[int, int]] = set()
    found: list[SeenPerson] = []
    for pair in sorted(pairs, key=lambda pair: -pair.scores[frame]):
        if pair.scores[frame] <= 0:
            break
        persons = pair.persons[frame]
        own = {(c, int(p)) for c, p in enumerate(persons) if p >= 0}
        if not own & taken:
            person = _seen(frame, cameras, used, persons, settings)
            if all(_apart(person, other) > settings.least_apart_m for other in found):
                taken |= own
                found.append(person)
    return found


def _apart(one: SeenPerson, other: SeenPerson) -> float:
    """Return the median distance of the joints of two people [m], or of their centres if they have no joint in common.

    It is infinite where one has no joint.
    """
    distance = np.linalg.norm(one.points - other.points, axis=1)
    if np.isfinite(distance).any():
        return float(np.nanmedian(distance))
    known = np.isfinite(one.points).any() and np.isfinite(other.points).any()
    return float(np.linalg.norm(one.centre - other.centre)) if known else np.inf


def _seen(
    frame: int, cameras: Sequence[Camera], used: Floats, persons: Integers, settings: AssociationSettings
) -> SeenPerson:
    """Triangulate a person's joints from all its images, twice: the second time only from those that agree."""
    own = np.stack([used[c, max(p, 0)] for c, p in enumerate(persons)])
    own[persons < 0] = np.nan
    agreeing = np.isfinite(own[..., 0])
    for _ in range(2):
        points = triangulate(cameras, np.where(agreeing[..., None], own, np.nan), sigma_px=1.0).points
        near = [_nearness(camera, points[None], own[None, c : c + 1], settings.tolerance_m)[0, 0]
                for c, camera in enumerate(cameras)]  # fmt: skip
        agreeing = np.array(near) >= 0
    points = np.where((agreeing.sum(0) >= 2)[:, None], points, np.nan)
    return SeenPerson(frame, np.array(persons), points, agreeing & np.isfinite(points[:, 0]))


def _link(tracks: list[PersonTrack], people: Sequence[SeenPerson], rate: float, settings: AssociationSettings) -> None:
    """Append the people of a frame to the tracks that end nearest to them, in all the best way, or begin new ones."""
    known = [person for person in people if np.isfinite(person.points).any()]
    cost = np.full((len(known), len(tracks)), np.inf)
    for i, person in enumerate(known):
        for j, track in enumerate(tracks):
            gap = (person.frame - track.seen[-1].frame) / rate
            apart = _apart(person, track.seen[-1])
            if gap <= settings.longest_gap and apart <= settings.speed * gap + settings.slack_m:
                cost[i, j] = apart
    finite = np.isfinite(cost)
    # A pair that cannot be the same person costs more than any set of pairs that can.
    rows, columns = linear_sum_assignment(np.where(finite, cost, 1.0 + cost[finite].sum()))
    chosen = {int(i): int(j) for i, j in zip(rows, columns, strict=True) if finite[i, j]}
    for i, person in enumerate(known):
        if i in chosen:
            tracks[chosen[i]].seen.append(person)
        else:
            tracks.append(PersonTrack([person]))
