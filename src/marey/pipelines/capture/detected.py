"""The person whose joints a detector found in the images of a trial."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from marey.arrays import Floats, Mask
from marey.errors import FileProblem
from marey.fit.recipes.detections import PersonDetections
from marey.fit.recipes.other_people import other_figures
from marey.fit.recipes.seen_people import AssociationSettings, PersonTrack, find_people
from marey.io.trial.key_points import read_key_points
from marey.pipelines.capture.run import Run
from marey.pipelines.people.other_regions import OtherFigures

LEAST_AGREEING = 0.6
"""Share of the detected joints about which cameras agree below which a warning is given. It is 0.73 to 1.00 in seven
takes, and 0.50 with the key points of another take of the same cameras."""


@dataclass(frozen=True, eq=False)
class DetectedPerson:
    """The detected joints of the person to follow, and the frames in which cameras agree about them."""

    joints: PersonDetections
    track: PersonTrack
    others: OtherFigures = field(default_factory=lambda: OtherFigures((), {}))
    """What the detector found of other people."""

    @property
    def elsewhere(self) -> Mask:
        """(F, C) true where the detector found only other people in an image, of whom no figure can be drawn."""
        unclear = np.array(self.joints.elsewhere)
        for frame, c in self.others.figures:
            unclear[frame, c] = False
        return unclear

    def clearest(self, frames: Sequence[int]) -> int | None:
        """Return the one of some frames in which most joints agree; None if the person is in none of them."""
        known = set(frames)
        seen = [person for person in self.track.seen if person.frame in known]
        return max(seen, key=lambda person: int(np.count_nonzero(person.agreeing))).frame if seen else None

    def agreeing_pixels(self, frame: int) -> Floats:
        """Return the pixels (C, J, 2) of a frame's joints about which cameras agree; NaN elsewhere."""
        return np.where(self.joints.agreeing[frame][..., None], self.joints.pixels[frame], np.nan)


def detected_person(run: Run) -> DetectedPerson | None:
    """Read the detected joints of a trial, and choose the person to follow: the longest and most completely seen one.

    Args:
        run: The run.

    Returns:
        The person; None if the trial has no detected joints.

    Raises:
        FileProblem: The files cannot be used, or no two cameras agree about a person.
    """
    trial = run.trial
    if trial.keypoints is None:
        return None
    with run.progress.stage("Key points"):
        points = read_key_points(trial.keypoints, trial.rig, count=trial.take.count)
        used = np.zeros(trial.take.count, bool)
        used[trial.take.first : trial.take.end] = True
        pixels = np.where(used[:, None, None, None, None], points.pixels, np.nan)
        people = find_people(list(trial.rig), pixels, points.confidence, rate=trial.take.rate)
    used_joints = points.confidence[trial.take.first : trial.take.end] >= AssociationSettings().least_confidence
    agreeing = sum(person.support for person in people) / max(int(np.count_nonzero(used_joints)), 1)
    if people and agreeing < LEAST_AGREEING:
        run.progress.warn(
            f"The cameras agree about only {agreeing:.0%} of the detected joints: check that {trial.keypoints} belongs "
            "to this recording, that its folders have the names of the cameras, and that the videos are synchronous."
        )
    if not people:
        wrong = "has no person about whose joints two cameras agree"
        remedy = "Check that the files belong to this recording, that the cameras are named alike, and the calibration."
        raise FileProblem(trial.keypoints, wrong, remedy)
    person = people[0]
    run.progress.report(
        f"Key points ({points.layout}): {len(people)} {'person' if len(people) == 1 else 'persons'} seen by at least "
        f"two cameras; the one of frames {person.seen[0].frame} to {person.seen[-1].frame} is followed"
    )
    joints = PersonDetections.of_track(
        tuple(trial.rig), points.joint_names, points.pixels, points.confidence, person
    )  # fmt: skip
    figures = other_figures(
        tuple(trial.rig), points.joint_names, pixels, points.confidence, people, person, rate=trial.take.rate
    )
    return DetectedPerson(joints, person, OtherFigures(points.joint_names, figures))
