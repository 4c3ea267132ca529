"""The person to follow as a user names it: a number, a click or box in an image, or a place in the world."""

import re
from dataclasses import dataclass

from marey.cameras.rig import Rig
from marey.errors import SettingProblem

FORMS = "a number, CAMERA:X,Y@FRAME, CAMERA:X0,Y0,X1,Y1@FRAME, or X,Y,Z@FRAME in metres"
"""The texts that name a person, for help and error messages."""
_NUMBER = r"\s*([-+]?\d+(?:\.\d*)?)\s*"
"""Pattern of a number in the text."""


@dataclass(frozen=True)
class PersonNumber:
    """A person by its number in the list that the program prints."""

    number: int


@dataclass(frozen=True)
class PersonClick:
    """A person by a pixel that shows it."""

    camera: str
    x: float
    y: float
    frame: int


@dataclass(frozen=True)
class PersonBox:
    """A person by a box about it in an image."""

    camera: str
    left: float
    top: float
    right: float
    bottom: float
    frame: int


@dataclass(frozen=True)
class PersonPlace:
    """A person by a place in the world, whose Z points up [m]."""

    x: float
    y: float
    z: float
    frame: int | None = None
    """The frame; None: in any frame."""


PersonChoice = PersonNumber | PersonClick | PersonBox | PersonPlace
"""All ways of naming a person."""


def parse_person(text: str | int) -> PersonChoice:
    """Read the text that names a person.

    Args:
        text: A number from 1; `cam01:310,220@40`, a pixel of camera and frame; `cam01:250,80,370,400@40`, a box; or
            `0.4,1.2,0.9@40`, a place in the world in metres, whose frame may be omitted.

    Raises:
        SettingProblem: The text has another form.
    """
    given = str(text).strip()
    if re.fullmatch(r"[-+]?\d+", given):
        if int(given) < 1:
            raise SettingProblem(_wrong(given, "the numbers of people begin with 1"))
        return PersonNumber(int(given))
    body, at, frame_text = given.partition("@")
    camera, colon, numbers_text = body.rpartition(":")
    numbers = [float(n) for n in numbers_text.split(",") if re.fullmatch(_NUMBER, n)]
    if at and not re.fullmatch(r"\s*\d+\s*", frame_text):
        raise SettingProblem(_wrong(given, f"'{frame_text}' after @ is not the number of a frame"))
    frame = int(frame_text) if at else None
    if len(numbers) != len(numbers_text.split(",")) or len(numbers) not in ((2, 4) if colon else (3,)):
        raise SettingProblem(_wrong(given, f"it should be {FORMS}"))
    if not colon:
        x, y, z = numbers
        return PersonPlace(x, y, z, frame)
    if frame is None:
        raise SettingProblem(_wrong(given, f"it lacks the frame, for example {given}@40"))
    name = camera.strip()
    if len(numbers) == 2:
        x, y = numbers
        return PersonClick(name, x, y, frame)
    left, top, right, bottom = numbers
    if left >= right or top >= bottom:
        raise SettingProblem(_wrong(given, "a box is CAMERA:X0,Y0,X1,Y1@FRAME with X0 < X1 and Y0 < Y1"))
    return PersonBox(name, left, top, right, bottom, frame)


def check_person(choice: PersonChoice, rig: Rig, frames: range) -> None:
    """Check that the camera, the pixel and the frame of a choice exist.

    Args:
        choice: The choice.
        rig: The cameras in use.
        frames: The frames in use.

    Raises:
        SettingProblem: One of them does not exist.
    """
    frame = None if isinstance(choice, PersonNumber) else choice.frame
    if frame is not None and frame not in frames:
        used = f"the frames in use are {frames.start} to {frames.stop - 1}"
        raise SettingProblem(_wrong(text_of(choice), f"there is no frame {frame}; {used}"))
    if not isinstance(choice, PersonClick | PersonBox):
        return
    if choice.camera not in rig.names:
        known = ", ".join(rig.names)
        raise SettingProblem(_wrong(text_of(choice), f"there is no camera '{choice.camera}'; there are {known}"))
    width, height = rig[choice.camera].size
    x, y = (choice.x, choice.y) if isinstance(choice, PersonClick) else (choice.left, choice.top)
    right, bottom = (x, y) if isinstance(choice, PersonClick) else (choice.right, choice.bottom)
    if right < -0.5 or bottom < -0.5 or x > width - 0.5 or y > height - 0.5:
        wrong = f"it lies outside of the images of {choice.camera}, which are {width} x {height} pixels"
        raise SettingProblem(_wrong(text_of(choice), wrong))


def text_of(choice: PersonChoice) -> str:
    """Return the text of a choice."""
    if isinstance(choice, PersonNumber):
        return str(choice.number)
    at = "" if choice.frame is None else f"@{choice.frame}"
    if isinstance(choice, PersonClick):
        return f"{choice.camera}:{choice.x:g},{choice.y:g}{at}"
    if isinstance(choice, PersonBox):
        return f"{choice.camera}:{choice.left:g},{choice.top:g},{choice.right:g},{choice.bottom:g}{at}"
    return f"{choice.x:g},{choice.y:g},{choice.z:g}{at}"


def _wrong(text: str, why: str) -> str:
    return f"The person (--person, or [people] follow in trial.toml) is '{text}': {why}."
