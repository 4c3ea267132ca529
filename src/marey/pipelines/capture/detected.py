"""The person whose joints a detector found in the images of a trial."""

from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby, product

import numpy as np

from marey.arrays import Floats, Mask
from marey.errors import FileProblem
from marey.fit.recipes.detections import PersonDetections
from marey.fit.recipes.other_people import other_figures
from marey.fit.recipes.present_people import PresentPerson, person_of_track
from marey.fit.recipes.seen_people import AssociationSettings, PersonTrack, find_people
from marey.io.trial.key_points import KeyPoints, read_key_points
from marey.io.trial.start_joints import StartJoints
from marey.io.trial.trial import Trial
from marey.pipelines.capture.run import Run
from marey.pipelines.people.choice import chosen_person, followed_text, given_start, person_of_start, started_person
from marey.pipelines.people.other_regions import OtherFigures
from marey.pipelines.progress import Progress
from marey.pipelines.silhouettes.empty_rooms import cameras_without_image

LEAST_AGREEING = 0.6
"""Share of the detected joints about which cameras agree below which a warning is given. It is 0.73 to 1.00 in seven
takes, and 0.50 with the key points of another take of the same cameras."""


OUTER_JOINTS = {"arm": ("elbow", "wrist"), "leg": ("knee", "ankle")}
"""Joints that determine a limb together with shoulder or hip, by kind of limb."""
LEAST_PRESENT = 0.2
"""Shortest presence of a person beside the longest one [s]; of short takes, a third is enough. Chosen by hand: shorter
ones are often wrong associations."""


@dataclass(frozen=True, eq=False)
class DetectedPerson:
    """The detected joints of the person to follow, and the frames in which cameras agree about them."""

    joints: PersonDetections
    track: PersonTrack
    others: OtherFigures = field(default_factory=lambda: OtherFigures((), {}))
    """What the detector found of other people."""
    people: int = 1
    """Number of people about whose joints cameras agree."""
    clear: Container[tuple[int, int]] = ()
    """Frame and number of the camera of images in which the other people are known from their captured bodies."""
    start: int | None = None
    """The frame whose joints the user has given, from which the person is followed; None without any."""

    @property
    def elsewhere(self) -> Mask:
        """(F, C) true where the detector found only other people in an image, of whom no figure can be drawn."""
        unclear = np.array(self.joints.elsewhere)
        for frame, c in np.argwhere(unclear):
            key = int(frame), int(c)
            unclear[frame, c] = key not in self.others.figures and key not in self.clear
        return unclear

    def clearest(self, frames: Sequence[int]) -> int | None:
        """Return the one of some frames in which most joints agree; None if the person is in none of them."""
        known = set(frames)
        seen = [person for person in self.track.seen if person.frame in known]
        return max(seen, key=lambda person: int(np.count_nonzero(person.agreeing))).frame if seen else None

    def started_from(self, joints: StartJoints) -> "DetectedPerson":
        """Return the person with the given joints of a frame, from which it is followed, instead of the detected ones.

        Args:
            joints: The joints that the user has given.
        """
        order = [joints.joint_names.index(name) for name in self.joints.joint_names]
        given = self.joints.with_given(joints.frame, joints.pixels[:, order], joints.confidence[:, order])
        persons = self.track.persons(joints.frame, len(given.cameras))
        track = self.track.with_seen(given.seen(joints.frame, persons))
        return replace(self, joints=given, track=track, start=joints.frame)

    def open_limbs(self, frames: Iterable[int], longest: float) -> dict[str, list[list[int]]]:
        """Return the frames in which fewer than two cameras agree about the joints of a limb.

        Args:
            frames: The frames with a pose.
            longest: Longest run of such frames over which the motion itself determines the limb [frames].

        Returns:
            Longer runs of successive frames, by limb, for example "left_arm".
        """
        count, names, known = self.joints.agreeing.sum(axis=1), self.joints.joint_names, sorted(frames)
        found = {}
        for side, (kind, outer) in product(("left", "right"), OUTER_JOINTS.items()):
            least = np.min([count[:, names.index(f"{side}_{name}")] for name in outer], axis=0)
            unseen = [frame for frame in known if least[frame] < 2]
            grouped = groupby(enumerate(unseen), key=lambda each: each[1] - each[0])
            runs = [[frame for _, frame in own] for _, own in grouped]
            found[f"{side}_{kind}"] = [run for run in runs if len(run) > longest]
        return {limb: runs for limb, runs in found.items() if runs}

    def agreeing_pixels(self, frame: int) -> Floats:
        """Return the pixels (C, J, 2) of a frame's joints about which cameras agree; NaN elsewhere."""
        return np.where(self.joints.agreeing[frame][..., None], self.joints.pixels[frame], np.nan)


@dataclass(frozen=True, eq=False)
class DetectedPeople:
    """All people about whose joints cameras agree."""

    points: KeyPoints
    pixels: Floats
    """(F, C, P, J, 2) the points of the frames in use [px]; NaN elsewhere."""
    tracks: Sequence[PersonTrack]
    """The people, in the order of their numbers."""

    @property
    def present(self) -> list[PresentPerson]:
        """The people with their places and heights."""
        return [person_of_track(track, self.points.joint_names) for track in self.tracks]


def detected_people_of(trial: Trial, progress: Progress) -> DetectedPeople | None:
    """Read the detected joints of a trial, and find all people in them; the one who was seen best is the first.

    Args:
        trial: The trial.
        progress: Progress reporter.

    Returns:
        The people; None if the trial has no detected joints.

    Raises:
        FileProblem: The files cannot be used, or no two cameras agree about a person.
    """
    if trial.keypoints is None:
        return None
    with progress.stage("Key points"):
        pictures = None if trial.take.common is None else trial.take.common.pictures
        points = read_key_points(
            trial.keypoints, trial.rig, count=trial.take.count, pictures=pictures, names=trial.file_names
        )
        used = np.zeros(trial.take.count, bool)
        used[trial.take.first : trial.take.end] = True
        pixels = np.where(used[:, None, None, None, None], points.pixels, np.nan)
        people = find_people(list(trial.rig), pixels, points.confidence, rate=trial.take.rate)
    used_joints = points.confidence[trial.take.first : trial.take.end] >= AssociationSettings().least_confidence
    agreeing = sum(person.support for person in people) / max(int(np.count_nonzero(used_joints)), 1)
    if people and agreeing < LEAST_AGREEING:
        progress.warn(
            f"The cameras agree about only {agreeing:.0%} of the detected joints: check that {trial.keypoints} belongs "
            "to this recording, that its folders have the names of the cameras, and that the videos are synchronous."
        )
    if not people:
        wrong = "has no person about whose joints two cameras agree"
        remedy = "Check that the files belong to this recording, that the cameras are named alike, and the calibration."
        raise FileProblem(trial.keypoints, wrong, remedy)
    return DetectedPeople(points, pixels, _long_enough(people, trial))


def _long_enough(tracks: Sequence[PersonTrack], trial: Trial) -> list[PersonTrack]:
    """Return the tracks that are not too short to be people; at least the first one."""
    least = min(round(LEAST_PRESENT * trial.take.rate), (trial.take.end - trial.take.first) // 3)
    return [track for i, track in enumerate(tracks) if i == 0 or len(track.seen) >= least]


def detected_person(run: Run) -> DetectedPerson | None:
    """Read the detected joints of a trial, and choose the person to follow.

    This is the one whom the user named, or whose joints are given as the start; otherwise the longest and most
    completely seen one.

    Args:
        run: The run.

    Returns:
        The person; None if the trial has no detected joints.

    Raises:
        FileProblem: The files cannot be used, or no two cameras agree about a person.
        SettingProblem: Nobody is where the user named a person.
    """
    trial = run.trial
    found = detected_people_of(trial, run.progress)
    if found is None:
        return None
    present = found.present
    bare = not trial.masks and bool(cameras_without_image(trial))
    # With silhouettes of one person, they are compared with the given joints.
    joints = given_start(trial) if bare or len(present) > 1 else None
    index = 0
    if trial.follow is not None:
        index = chosen_person(present, trial.follow, trial.rig)
    elif joints is not None:
        index = started_person(present, joints, trial)
    points, person = found.points, found.tracks[index]
    run.progress.report(f"Key points ({points.layout}): {followed_text(present, index)}")
    joint_names, cameras = points.joint_names, tuple(trial.rig)
    joints_of_person = PersonDetections.of_track(cameras, joint_names, points.pixels, points.confidence, person)
    if run.times is not None:
        joints_of_person = joints_of_person.at_frames(run.times)
    known = [track for number, track in enumerate(found.tracks, 1) if number in run.captured]
    figures, every = (
        other_figures(
            cameras, joint_names, found.pixels, points.confidence, found.tracks, person, rate=trial.take.rate,
            known=without,
        )
        for without in (known, ())
    )  # fmt: skip
    others = OtherFigures(joint_names, figures, [camera.width for camera in cameras])
    own = DetectedPerson(joints_of_person, person, others, len(found.tracks), frozenset(every))
    if joints is None or trial.masks or person_of_start(present, joints, trial.rig) != index:
        return own
    return own.started_from(joints)
