"""The people in the foreground of a take: who is followed, and where the others hide the person."""

from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask
from marey.cameras.camera import Camera
from marey.fit.recipes.present_people import PresentPerson, person_of_hull
from marey.fit.recipes.seen_people import PersonTrack
from marey.fit.search.hull import drawn_cells
from marey.fit.search.hull_people import HullPeopleSettings, HullTrack, find_hull_people, hull_height
from marey.fit.solver.threads import map_in_threads
from marey.io.trial.trial import Trial
from marey.pipelines.people.choice import chosen_person, followed_text, given_start, started_person
from marey.pipelines.people.other_regions import OtherRegions, widened
from marey.pipelines.progress import Progress

PEEKED = 16
"""Number of frames that are checked for several people before all are. Chosen by hand."""
LEAST_PRESENT_SHARE = 0.2
"""Least share of the frames in which a person must be present beside the longest one. Chosen by hand."""
LEAST_PERSON_M = 0.9
"""Least usual height of a person beside the longest present one [m]. Chosen by hand: parts of the foreground beside the
person of `tpose` are 0.72 m tall."""
SAME_PERSON_M = 0.6
"""Largest median distance of a person in the foreground from the same one by detected joints [m]. Chosen by hand."""

THIN_SDS = 10.0
"""Distance from a person's part of the hull, which lacks thin hands, up to which the foreground belongs to the person,
in standard deviations of its outline. Chosen by hand."""

MasksOfFrame = Callable[[int], Sequence[Mask]]
"""Returns the foreground of a frame, one mask (height, width) per camera."""


@dataclass(frozen=True, eq=False)
class OtherHulls:
    """Other people of a take as parts of the visual hull."""

    tracks: Sequence[HullTrack]
    cell_m: float

    def regions(self, frame: int, number: int, camera: Camera, place: Floats) -> OtherRegions | None:
        """Return where other people are in an image.

        Args:
            frame: The frame.
            number: Number of the camera.
            camera: The camera.
            place: (3,) place of the followed person in the world [m].

        Returns:
            The regions; None if there is nobody else.
        """
        others = [track for track in self.tracks if frame in track.cells]
        if not others:
            return None
        away = float(np.linalg.norm(place - camera.centre))
        front, behind = np.zeros((2, camera.height, camera.width), bool)
        for track in others:
            drawn = drawn_cells(camera, track.cells[frame], self.cell_m)
            nearer = np.linalg.norm(track.middle(frame) - camera.centre) < away
            front, behind = (front | drawn, behind) if nearer else (front, behind | drawn)
        scale = float(camera.matrix[0, 0]) / away
        return OtherRegions(front, behind, 0.25 * self.cell_m * scale)


@dataclass(frozen=True, eq=False)
class ForegroundPerson:
    """The followed one of several people in the foreground."""

    track: HullTrack
    others: OtherHulls
    rough: OtherHulls
    """The other people without those who are modelled more accurately."""

    def silhouettes(
        self, frame: int, cameras: Sequence[Camera], masks: Sequence[Mask]
    ) -> tuple[list[Mask], list[Mask]]:
        """Return the part of the foreground that is the followed person, and where others hide it, by camera."""
        if frame not in self.track.cells:
            nothing = [np.zeros_like(mask) for mask in masks]
            return nothing, nothing
        own, hidden = [], []
        for c, (camera, mask) in enumerate(zip(cameras, masks, strict=True)):
            regions = self.others.regions(frame, c, camera, self.track.middle(frame))
            if regions is None:
                own.append(np.asarray(mask))
                hidden.append(np.zeros_like(mask))
                continue
            drawn = drawn_cells(camera, self.track.cells[frame], self.others.cell_m)
            about = widened(drawn, THIN_SDS * regions.sd_px) & ~regions.near
            own.append(mask & (drawn | about) & ~regions.front)
            hidden.append(regions.near)
        return own, hidden


def people_in_foreground(
    trial: Trial, cameras: Sequence[Camera], masks_of: MasksOfFrame, frames: Sequence[int], progress: Progress
) -> tuple[list[HullTrack], list[PresentPerson]]:
    """Find all people in the foreground, in the order of their numbers.

    Args:
        trial: The trial.
        cameras: C cameras of the size of the masks.
        masks_of: The foreground by frame.
        frames: The frames that show somebody.
        progress: Progress reporter.
    """
    settings = HullPeopleSettings()
    with progress.stage("People", len(frames)) as step:
        tracks = find_hull_people(cameras, masks_of, frames, rate=trial.take.rate, progress=lambda frame: step())
    longest = max((len(track.cells) for track in tracks), default=0)
    tracks = [
        track
        for i, track in enumerate(tracks)
        if i == 0
        or (len(track.cells) >= LEAST_PRESENT_SHARE * longest and hull_height(track, settings.cell_m) >= LEAST_PERSON_M)
    ]
    return tracks, [person_of_hull(track, settings.cell_m) for track in tracks]


def foreground_person(
    trial: Trial, cameras: Sequence[Camera], masks_of: MasksOfFrame, frames: Sequence[int], progress: Progress,
    detected: PersonTrack | None = None, known: Container[int] = (),
) -> ForegroundPerson | None:  # fmt: skip
    """Find the person to follow among several people in the foreground.

    Args:
        trial: The trial, with the user's choice.
        cameras: C cameras of the size of the masks.
        masks_of: The foreground by frame.
        frames: The frames that show somebody.
        progress: Progress reporter.
        detected: The person to follow by detected joints, if there are any.
        known: Numbers of the people who are modelled more accurately: their part of the hull is used only for the first
            silhouettes.

    Returns:
        The person; None if only one is present.

    Raises:
        SettingProblem: Nobody is where the user named a person.
    """
    settings, rate = HullPeopleSettings(), trial.take.rate
    peeked = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, min(PEEKED, len(frames))).astype(int))]

    def shows_several(masks: Sequence[Mask]) -> bool:
        return len(find_hull_people(cameras, lambda _: masks, [0], rate=rate)) > 1

    several = any(map_in_threads(shows_several, map(masks_of, peeked)))
    if not several and (trial.follow is None or detected is not None):
        return None
    tracks, people = people_in_foreground(trial, cameras, masks_of, frames, progress)
    if detected is not None:
        index = _same_person(tracks, detected)
        if index is None:
            return None
    else:
        index = 0
        if trial.follow is not None:
            index = chosen_person(people, trial.follow, trial.rig)
        elif len(people) > 1 and (joints := given_start(trial)) is not None:
            index = started_person(people, joints, trial)
        if len(people) > 1:
            progress.report(f"Foreground: {followed_text(people, index)}")
    others = [track for i, track in enumerate(tracks) if i != index]
    rough = [track for i, track in enumerate(tracks) if i != index and (detected is not None or i + 1 not in known)]
    if not others:
        return None
    return ForegroundPerson(
        tracks[index], OtherHulls(others, settings.cell_m), OtherHulls(rough, settings.cell_m)
    )  # fmt: skip


def _same_person(tracks: Sequence[HullTrack], detected: PersonTrack) -> int | None:
    """Return the index of the person in the foreground who is nearest to one with detected joints."""
    best, least = None, SAME_PERSON_M
    for i, track in enumerate(tracks):
        apart = [
            float(np.linalg.norm((track.middle(seen.frame) - seen.centre)[:2]))
            for seen in detected.seen
            if seen.frame in track.cells
        ]
        if apart and np.median(apart) < least:
            best, least = i, float(np.median(apart))
    return best
