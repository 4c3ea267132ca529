"""Where people other than the followed one are in the images, from the joints that a detector found."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.fit.recipes.person_figures import LEAST_FIGURE_JOINTS, PersonFigure, draw_figures, figure_distance
from marey.fit.recipes.seen_people import AssociationSettings, PersonTrack, SeenPerson

LONGEST_HIDDEN = 0.5
"""Longest time between two frames of another person over which the joints are interpolated [s]. Chosen by hand."""
SAME_OVERLAP, SAME_MARGIN_M = 0.5, 0.05
"""Intersection over union of the figures of a detection and of the followed person from which on the detection shows
the followed person, and the distance by which both are enlarged [m]. Chosen by hand: `balancing` has detections of
the followed person with exchanged sides."""
LINKED_M = 0.3
"""Median distance of the joints of two detections in successive frames of one camera up to which they are the same
person [m]. Chosen by hand."""
LEAST_DETECTIONS = 3
"""Least number of frames of a person that only one camera detects, over which gaps are filled. Chosen by hand."""
NEAREST_M = 0.1
"""Least depth of a joint that is projected into an image [m]. Chosen by hand."""

FiguresByImage = Mapping[tuple[int, int], Sequence[PersonFigure]]
"""Figures of the other people by frame and number of the camera."""


def other_figures(
    cameras: Sequence[Camera], joint_names: Sequence[str], pixels: Floats, confidence: Floats,
    tracks: Sequence[PersonTrack], followed: PersonTrack, *, rate: float,
    known: Sequence[PersonTrack] = (), settings: AssociationSettings | None = None,
) -> FiguresByImage:  # fmt: skip
    """Collect what a detector found of other people, as figures in the images.

    A person about whom several cameras agree is also drawn in images in which the detector missed it. One who was
    found by a single camera is drawn in this camera only.

    Args:
        cameras: C cameras.
        joint_names: Names of the J joints.
        pixels: (F, C, P, J, 2) of all detections [px].
        confidence: (F, C, P, J).
        tracks: All persons about whom several cameras agree.
        followed: The person to follow, one of them.
        rate: Frame rate [Hz].
        known: People of whom no figure is needed.
        settings: Settings of the association.

    Returns:
        The figures by frame and number of the camera; images without other people are missing.
    """
    settings = settings or AssociationSettings()
    used = np.where((confidence >= settings.least_confidence)[..., None], pixels, np.nan)
    longest = max(1, round(LONGEST_HIDDEN * rate))
    figures: dict[tuple[int, int], list[PersonFigure]] = defaultdict(list)
    for track in tracks:
        if track is not followed and not any(track is other for other in known):
            _add_track(figures, cameras, used, track, longest)
    single = _unassociated(cameras, joint_names, used, tracks, followed)
    for c, camera in enumerate(cameras):
        _add_single(figures, c, camera, joint_names, [found[c] for found in single], longest)
    return dict(figures)


def _add_track(
    figures: dict[tuple[int, int], list[PersonFigure]], cameras: Sequence[Camera], used: Floats, track: PersonTrack,
    longest: int,
) -> None:  # fmt: skip
    """Add a person with known joints in space: the detected pixels, and projected joints where they are missing."""
    points = {seen.frame: seen.points for seen in track.seen}
    persons = {seen.frame: seen.persons for seen in track.seen}
    for before, after in pairwise(sorted(points)):
        if after - before <= longest:
            for frame in range(before + 1, after):
                share = (frame - before) / (after - before)
                points[frame] = (1 - share) * points[before] + share * points[after]
    for frame, joints in points.items():
        known = np.isfinite(joints).all(1)
        if np.count_nonzero(known) < LEAST_FIGURE_JOINTS:
            continue
        for c, camera in enumerate(cameras):
            seen = np.full((len(joints), 2), np.nan)
            ahead = known & (camera.depths(joints) > NEAREST_M)
            if ahead.any():
                seen[ahead] = camera.project(joints[ahead])
            p = persons[frame][c] if frame in persons else -1
            own = used[frame, c, p] if p >= 0 else np.full_like(seen, np.nan)
            seen = np.where(np.isfinite(own), own, seen)
            if np.isfinite(seen).all(1).sum() >= LEAST_FIGURE_JOINTS:
                away = float(np.linalg.norm(np.nanmedian(joints, axis=0) - camera.centre))
                figures[frame, c].append(PersonFigure(seen, away))


def _unassociated(
    cameras: Sequence[Camera], joint_names: Sequence[str], used: Floats, tracks: Sequence[PersonTrack],
    followed: PersonTrack,
) -> list[list[list[Floats]]]:  # fmt: skip
    """Return the detections (J, 2) by frame and camera that belong to nobody whose joints in space are known."""
    owners = [{seen.frame: seen for seen in track.seen} for track in tracks]
    own = {seen.frame: seen for seen in followed.seen}
    found = []
    for frame, views in enumerate(used):
        taken = [by_frame[frame].persons for by_frame in owners if frame in by_frame]
        of_frame: list[list[Floats]] = []
        for c, detections in enumerate(views):
            free = [p for p in range(len(detections)) if not any(persons[c] == p for persons in taken)]
            enough = [p for p in free if np.isfinite(detections[p, :, 0]).sum() >= LEAST_FIGURE_JOINTS]
            if frame in own:
                number = own[frame].persons[c]
                mine = detections[number] if number >= 0 else None
                enough = [p for p in enough if not _duplicate(cameras[c], joint_names, detections[p], mine, own[frame])]
            of_frame.append([detections[p] for p in enough])
        found.append(of_frame)
    return found


def _duplicate(
    camera: Camera, joint_names: Sequence[str], detection: Floats, mine: Floats | None, own: SeenPerson
) -> bool:
    """Return whether a detection covers about the same region as the followed person, however its joints are named.

    Args:
        camera: The camera.
        joint_names: Names of the J joints.
        detection: (J, 2) the detection [px].
        mine: (J, 2) the followed person's own detection in this image [px]; None if there is none.
        own: The followed person in this frame.
    """
    joints = np.full_like(detection, np.nan)
    known = np.isfinite(own.points).all(1)
    joints[known] = camera.project(own.points[known])
    if mine is not None:
        joints = np.where(np.isfinite(mine), mine, joints)
    away = float(np.linalg.norm(own.centre - camera.centre))
    one, other = (
        draw_figures(camera, joint_names, [PersonFigure(pixels, away)], margin_m=SAME_MARGIN_M)
        for pixels in (detection, joints)
    )
    return bool(np.count_nonzero(one & other) >= SAME_OVERLAP * np.count_nonzero(one | other))


def _add_single(
    figures: dict[tuple[int, int], list[PersonFigure]], c: int, camera: Camera, joint_names: Sequence[str],
    found: Sequence[Sequence[Floats]], longest: int,
) -> None:  # fmt: skip
    """Add the people of one camera's images, also between their detections."""
    for run in _linked(camera, joint_names, found, longest):
        frames = sorted(run)
        for before, after in pairwise([*frames, frames[-1] + 1]):
            for frame in range(before, after if len(frames) >= LEAST_DETECTIONS else before):
                figures[frame, c].append(_between(run[before], run.get(after), (frame - before) / (after - before)))


def _linked(
    camera: Camera, joint_names: Sequence[str], found: Sequence[Sequence[Floats]], longest: int
) -> list[dict[int, PersonFigure]]:
    """Link the detections (J, 2) of one camera's frames: one run of figures by frame per person."""
    runs: list[dict[int, PersonFigure]] = []
    for frame, detections in enumerate(found):
        for pixels in detections:
            figure = PersonFigure(pixels, figure_distance(camera, joint_names, pixels))
            if not np.isfinite(figure.distance_m):
                continue
            near = LINKED_M * camera.matrix[0, 0] / figure.distance_m
            best, least = None, np.inf
            for run in runs:
                last = max(run)
                apart = _apart(pixels, run[last].pixels)
                if 0 < frame - last <= longest and apart < min(least, near * np.sqrt(frame - last)):
                    best, least = run, apart
            if best is None:
                best = {}
                runs.append(best)
            best[frame] = figure
    return runs


def _apart(one: Floats, other: Floats) -> float:
    """Return the median distance of the joints that two figures have in common; infinite without any."""
    apart = np.linalg.norm(one - other, axis=1)
    return float(np.nanmedian(apart)) if np.isfinite(apart).any() else np.inf


def _between(one: PersonFigure, other: PersonFigure | None, share: float) -> PersonFigure:
    """Interpolate between two figures; without the second one the first is returned."""
    if other is None or share == 0:
        return one
    mixed = (1 - share) * one.pixels + share * other.pixels
    return PersonFigure(mixed, (1 - share) * one.distance_m + share * other.distance_m)
