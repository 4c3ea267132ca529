"""The people of a take who were tracked by regions: who is followed, and where the others are."""

from collections.abc import Container, Mapping, Sequence

from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.body.people.person import stature
from marey.fit.recipes.person import interpolated_poses
from marey.fit.recipes.present_people import PresentPerson
from marey.fit.regions.region_track import RegionTrack
from marey.io.trial.trial import Trial
from marey.pipelines.people.choice import chosen_person, followed_text
from marey.pipelines.people.other_regions import JoinedPeople, OtherPeople, PosedPerson
from marey.pipelines.progress import Progress

REGION_SD_M = 0.05
"""Standard deviation of the outline of a person tracked by regions [m]: joints are 50 to 100 mm off, mostly along the
lines of sight."""


def longest_first(tracks: Sequence[RegionTrack]) -> list[RegionTrack]:
    """Return the people in the order of their numbers: by their time in the take, then by the mean score."""
    return sorted(tracks, key=lambda track: (-len(track.poses), -track.mean_score))


def person_of_region(body: Body, poses: Mapping[int, Pose]) -> PresentPerson:
    """Return a person who was tracked by regions; the height is the body's stature, which is roughly estimated."""
    points = {frame: PosedBody(body, pose).segment_origin for frame, pose in poses.items()}
    return PresentPerson(points, stature(body)[0])


def followed_region(
    trial: Trial, tracks: Sequence[RegionTrack], progress: Progress, started: RegionTrack | None = None
) -> int:
    """Return the index of the person to follow among those who were tracked by regions.

    Args:
        trial: The trial, with the user's choice.
        tracks: The people, in the order of their numbers.
        progress: Progress reporter.
        started: The person whose joints are given; None without any.

    Raises:
        SettingProblem: Nobody is where the user named a person.
    """
    people = [person_of_region(track.body, track.poses) for track in tracks]
    index = 0 if started is None else next(i for i, track in enumerate(tracks) if track is started)
    if trial.follow is not None:
        index = chosen_person(people, trial.follow, trial.rig)
    if len(people) > 1:
        progress.report(f"Colours and motion: {followed_text(people, index)}")
    return index


def others_of_regions(
    people: Sequence[tuple[Body, Mapping[int, Pose]]], index: int, longest_gap: float, known: Container[int]
) -> OtherPeople | None:
    """Return the people other than the followed one.

    Args:
        people: Body and poses of each person, in the order of their numbers.
        index: The index of the followed one.
        longest_gap: Longest gap of a track that is interpolated [frames].
        known: Numbers of the people who are modelled more accurately.

    Returns:
        Their regions; None if there is nobody else.
    """
    parts = [
        PosedPerson(body, {**poses, **interpolated_poses(poses, longest=longest_gap)}, REGION_SD_M)
        for i, (body, poses) in enumerate(people)
        if i != index and i + 1 not in known
    ]
    return JoinedPeople(parts) if parts else None
