"""The settings of a trial: the tables of trial.toml and what replaces them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)
from pydantic_core import ErrorDetails

from marey.cameras.shutter import Side
from marey.errors import FileProblem, SettingProblem
from marey.io.documents import Number, WholeNumber, read_tables

Preset = Literal["full", "upper", "left_arm", "right_arm", "left_leg", "right_leg"]
Up = Literal["z", "-z", "y", "-y", "x", "-x"]

_LONGEST_PART = 255
"""Largest length of a file's name on common systems [bytes]."""


def _path_text(text: str) -> str:
    """Check that a text can be a path."""
    if "\0" in text or any(len(part.encode("utf-8", "replace")) > _LONGEST_PART for part in text.split("/")):
        raise ValueError(f"its parts should have at most {_LONGEST_PART} bytes, and no zero bytes")
    return text


PathText = Annotated[str, Field(min_length=1, max_length=2000), AfterValidator(_path_text)]


def _one_fault(wanted: str) -> WrapValidator:
    """Return a validator that replaces the faults of all types of a union by one."""

    def checked(value: object, check: ValidatorFunctionWrapHandler) -> object:
        try:
            return check(value)
        except ValidationError:
            raise ValueError(f"it should be {wanted}, or a table with one by camera") from None

    return WrapValidator(checked)


_Time = Annotated[Number, Field(ge=0, lt=1)]
Readout = Annotated[_Time | Mapping[str, _Time], _one_fault("a time from 0 to less than 1 s")]
ReadoutSide = Annotated[Side | Mapping[str, Side], _one_fault('"top", "bottom", "left" or "right"')]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class StartTable(_Table):
    """The table `[start]`."""

    file: PathText
    """Path of the 2-D joints of one frame, relative to the trial: JSON, or a folder of OpenPose."""


class BackgroundTable(_Table):
    """The table `[background]`."""

    folder: PathText
    """Folder with images or clips of the empty room, relative to the trial."""


class KeyPointsTable(_Table):
    """The table `[keypoints]`."""

    folder: PathText
    """Folder with the detected joints of all images, relative to the trial."""


class PeopleTable(_Table):
    """The table `[people]`."""

    follow: int | str
    """The person to follow, as `marey.io.trial.person_choice.parse_person` reads it."""


class MasksTable(_Table):
    """The table `[masks]`."""

    use: Literal["final", "evidence"] | None = None
    """Whether the silhouettes in `masks/` are those of the result, or evidence beside that of the images."""
    network: PathText | None = None
    """Path of a network that segments people, relative to the trial: TFLite or ONNX."""


class WorldTable(_Table):
    """The table `[world]`."""

    up: Up
    """The axis of the calibration that points up."""


class TrialSettings(_Table):
    """The settings of trial.toml; all are optional."""

    stature_m: Annotated[Number, Field(gt=0.3, lt=2.8)] | None = None
    leg_length_m: Annotated[Number, Field(gt=0.2, lt=1.5)] | None = None
    """From the anterior superior iliac spine to the medial malleolus."""
    asis_distance_m: Annotated[Number, Field(gt=0.08, lt=0.5)] | None = None
    """Between the anterior superior iliac spines."""
    mass_kg: Annotated[Number, Field(gt=1, lt=400)] | None = None
    preset: Preset | None = None
    cameras: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """Names of the cameras to use; all by default."""
    frames: tuple[Annotated[WholeNumber, Field(ge=0)], WholeNumber | None] | None = None
    """First frame, and the frame after the last one (None: up to the end)."""
    rate: Annotated[Number, Field(gt=0, lt=100000)] | None = None
    """Frame rate [Hz]."""
    person: int | str | None = None
    calibration: PathText | None = None
    """Path of the calibration, relative to the trial; by default it is searched."""
    videos: Mapping[str, PathText] | None = None
    """Path of the video of each camera, relative to the trial, where the names do not agree."""
    sync: Literal["file", "off"] | None = None
    """"file": the clocks of the cameras are those of sync.json, if there is one; "off": they are the same clock. By
    default, `capture` also checks them if there is no file."""
    readout_s: Readout | None = None
    """Time from the first to the last row of a picture of a rolling shutter [s]: of all cameras, or by camera."""
    readout_from: ReadoutSide | None = None
    """The side of the picture that is exposed first: of all cameras, or by camera."""
    check: Literal["off"] | None = None
    """"off": `capture` does not check the cameras against each other."""
    start: StartTable | None = None
    keypoints: KeyPointsTable | None = None
    people: PeopleTable | None = None
    background: BackgroundTable | None = None
    masks: MasksTable | None = None
    world: WorldTable | None = None


def read_settings(folder: Path, **changes: object) -> TrialSettings:
    """Read trial.toml, if there is one, and replace settings.

    Args:
        folder: The trial.
        **changes: Settings by name that replace those of the file; None leaves the file's.

    Returns:
        The settings.

    Raises:
        FileProblem: A key is unknown or a value invalid; the message lists all faults.
        SettingProblem: A replacement is invalid.
    """
    path = folder / "trial.toml"
    tables = read_tables(path) if path.exists() else {}
    try:
        settings = TrialSettings.model_validate(tables)
    except ValidationError as error:
        known = "The known keys are stature_m, leg_length_m, asis_distance_m, mass_kg, preset, cameras, frames, rate,"
        more = "person, sync, check, readout_s, readout_from, [start] file, [keypoints] folder, [people] follow,"
        more += " [background] folder, [masks] use, [masks] network, [world] up, calibration and [videos] CAMERA."
        raise FileProblem(path, _faults(error), f"{known} {more}") from error
    given = {name: value for name, value in changes.items() if value is not None}
    masks = given.get("masks")
    if isinstance(masks, Mapping) and settings.masks is not None:
        given["masks"] = settings.masks.model_dump() | dict(masks)
    try:
        return TrialSettings.model_validate(settings.model_dump() | given)
    except ValidationError as error:
        raise SettingProblem(f"The settings are invalid: {setting_faults(error)}.") from error


_ARGUMENTS = {
    "stature_m": "stature (--stature)", "leg_length_m": "leg length (--leg-length)",
    "asis_distance_m": "ASIS distance (--asis-distance)", "preset": "preset (--preset)",
    "cameras": "cameras (--cameras)", "frames": "frames (--frames)", "sync": "sync (--sync)",
    "check": "check (--check)",
}  # fmt: skip
"""Maps settings to their names as arguments and options."""


def setting_faults(error: ValidationError) -> str:
    """Return the faults that pydantic found in arguments or options as one line of text.

    Args:
        error: What pydantic raised.
    """
    clauses: dict[str, None] = {}
    for fault in error.errors():
        key, why = _key_and_reason(fault)
        unknown = fault["type"] == "extra_forbidden"
        name = _ARGUMENTS.get(key, key)
        clauses[f"there is no setting {key}" if unknown else f"{name} is {fault['input']!r} ({why})"] = None
    return "; ".join(clauses)


def _key_and_reason(fault: ErrorDetails) -> tuple[str, str]:
    key = ".".join(part for part in fault["loc"] if isinstance(part, str))
    why = fault["msg"].replace("Input should", "It should").removeprefix("Value error, ")
    return key, why[0].lower() + why[1:]


def _faults(error: ValidationError) -> str:
    """Return the faults that pydantic found in a file as one line of text."""
    clauses: dict[str, None] = {}
    for fault in error.errors():
        key, why = _key_and_reason(fault)
        if fault["type"] == "extra_forbidden":
            clauses[f"has the unknown key '{key}'"] = None
        elif fault["type"] == "model_type":
            clauses[f"has {key} = {fault['input']!r}, which should be a table [{key}]"] = None
        else:
            clauses[f"has {key} = {fault['input']!r}, which is invalid ({why})"] = None
    return "; ".join(clauses)
