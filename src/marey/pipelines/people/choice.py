"""The choice of the person to follow among those who are present."""

from collections.abc import Sequence

import numpy as np

from marey.cameras.rig import Rig
from marey.cameras.triangulate import triangulate
from marey.errors import FileProblem, SettingProblem
from marey.fit.recipes.present_people import (
    PLACE_M,
    PresentPerson,
    person_at_pixel,
    person_at_place,
    person_in_box,
)
from marey.io.trial.person_choice import PersonBox, PersonChoice, PersonClick, PersonNumber, PersonPlace, text_of
from marey.io.trial.start_joints import StartJoints, read_start_joints
from marey.io.trial.trial import Trial


def chosen_person(people: Sequence[PresentPerson], choice: PersonChoice, rig: Rig) -> int:
    """Return the index of the person that a user named.

    Args:
        people: The people, in the order of their numbers.
        choice: The choice; its camera and frame exist.
        rig: The cameras.

    Raises:
        SettingProblem: There is nobody.
    """
    found: int | None
    if isinstance(choice, PersonNumber):
        found = choice.number - 1 if choice.number <= len(people) else None
    elif isinstance(choice, PersonClick):
        found = person_at_pixel(people, rig[choice.camera], np.array([choice.x, choice.y]), choice.frame)
    elif isinstance(choice, PersonBox):
        box = np.array([choice.left, choice.top, choice.right, choice.bottom])
        found = person_in_box(people, rig[choice.camera], box, choice.frame)
    else:
        found = person_at_place(people, np.array([choice.x, choice.y, choice.z]), choice.frame)
    if found is None:
        given = f"The person (--person, or [people] follow in trial.toml) is '{text_of(choice)}'"
        raise SettingProblem(f"{given}: {_nobody(people, choice)}. The command with --list-people shows everybody.")
    return found


def _nobody(people: Sequence[PresentPerson], choice: PersonChoice) -> str:
    """Return why a choice names nobody."""
    if isinstance(choice, PersonNumber):
        count = len(people)
        return f"there {'is only 1 person' if count == 1 else f'are only {count} people'}"
    if choice.frame is None:
        return "nobody was found near this place in any frame"
    others = _present(people, choice.frame)
    where = "place" if isinstance(choice, PersonPlace) else "part of the image"
    return f"nobody was found in this {where} ({others})"


def _present(people: Sequence[PresentPerson], frame: int) -> str:
    """Return who is present in a frame, and where."""
    present = [f"{i + 1} at {_place(person, frame)}" for i, person in enumerate(people) if frame in person.points]
    return f"people in frame {frame}: {', '.join(present)}" if present else "nobody was found in this frame"


def _place(person: PresentPerson, frame: int) -> str:
    x, y, _ = person.middle(frame)
    return f"({x:.1f}, {y:.1f}) m"


def given_start(trial: Trial) -> StartJoints | None:
    """Read the joints of one frame of a trial from which the tracking starts.

    Args:
        trial: The trial.

    Returns:
        The joints; None if the trial gives none.

    Raises:
        FileProblem: The file cannot be used, or its frame is not one of those in use.
    """
    if trial.start is None:
        return None
    return read_start_joints(trial.start, trial.rig, frames=range(trial.take.first, trial.take.end))


def person_of_start(people: Sequence[PresentPerson], joints: StartJoints, rig: Rig) -> int | None:
    """Return the index of the person whose joints were clicked; None if nobody is at their place.

    In the clicked frame, the person may have been missed for a moment.

    Args:
        people: The people, in the order of their numbers.
        joints: The clicked joints of one frame.
        rig: The cameras.
    """
    points = triangulate(list(rig), joints.pixels, sigma_px=1.0).points
    known = np.isfinite(points).all(1)
    if not known.any():
        return None
    place, best, least = np.median(points[known], axis=0), None, PLACE_M
    for i, person in enumerate(people):
        if person.frames[0] <= joints.frame <= person.frames[-1]:
            middle = person.middle(person.nearest_frame(joints.frame))
            apart = float(np.linalg.norm(middle[:2] - place[:2]))
            best, least = (i, apart) if apart < least else (best, least)
    return best


def started_person(people: Sequence[PresentPerson], joints: StartJoints, trial: Trial) -> int:
    """Return the index of the person whose joints were clicked.

    Args:
        people: The people, in the order of their numbers.
        joints: The clicked joints of one frame of the trial.
        trial: The trial.

    Raises:
        FileProblem: Nobody is at their place.
    """
    found = person_of_start(people, joints, trial.rig)
    if found is None:
        present = _present(people, joints.frame)
        wrong = f"has joints of frame {joints.frame} at a place where nobody was found ({present})"
        remedy = "Give at least three joints in two cameras each; --list-people shows everybody."
        raise FileProblem(trial.start or trial.folder, wrong, remedy)
    return found


def followed_text(people: Sequence[PresentPerson], index: int) -> str:
    """Return a sentence about the people who are present, and how to choose another one than the followed one."""
    frames = people[index].frames
    seen = f"frame {frames[0]}" if len(frames) == 1 else f"frames {frames[0]} to {frames[-1]}"
    if len(people) == 1:
        return f"1 person; {seen}"
    return (
        f"{len(people)} people; number {index + 1} ({seen}) is followed. --person follows another one, --people all "
        "everybody; --list-people shows them"
    )
