"""The choice of the person to follow among those who are present."""

from collections.abc import Sequence

import numpy as np

from marey.cameras.rig import Rig
from marey.cameras.triangulate import triangulate
from marey.errors import SettingProblem
from marey.fit.recipes.present_people import PresentPerson, person_at_pixel, person_at_place, person_in_box
from marey.io.trial.person_choice import PersonBox, PersonChoice, PersonClick, PersonNumber, PersonPlace, text_of
from marey.io.trial.start_joints import StartJoints


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
    present = [f"{i + 1} at {_place(person, choice.frame)}" for i, person in enumerate(people)
               if choice.frame in person.points]  # fmt: skip
    others = f"people in frame {choice.frame}: {', '.join(present)}" if present else "nobody was found in this frame"
    where = "place" if isinstance(choice, PersonPlace) else "part of the image"
    return f"nobody was found in this {where} ({others})"


def _place(person: PresentPerson, frame: int) -> str:
    x, y, _ = person.middle(frame)
    return f"({x:.1f}, {y:.1f}) m"


def person_of_start(people: Sequence[PresentPerson], joints: StartJoints, rig: Rig) -> int | None:
    """Return the index of the person whose joints were clicked; None if nobody is at their place.

    Args:
        people: The people, in the order of their numbers.
        joints: The clicked joints of one frame.
        rig: The cameras.
    """
    points = triangulate(list(rig), joints.pixels, sigma_px=1.0).points
    known = np.isfinite(points).all(1)
    if not known.any():
        return None
    return person_at_place(people, np.median(points[known], axis=0), joints.frame)


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
