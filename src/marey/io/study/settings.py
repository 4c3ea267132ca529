"""The settings of a study: the tables of study.toml."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from marey.errors import FileProblem
from marey.io.documents import Number, WholeNumber, read_tables
from marey.io.trial.settings import PathText, Preset

STUDY_FILE = "study.toml"
"""Name of the file with the settings of a study."""
PLACEHOLDERS = ("trial", "folder", "subject", "condition", "results")
"""What a path of study.toml may contain in braces; see `docs/reference/study.md`."""
FIELDS = ("subject", "condition")
"""What the pattern of the trials may contain in braces."""
_EXAMPLE = 'A short one is: pattern = "{subject}/{condition}_*.c3d", and below it [[steps]] and command = "markers".'
"""Remedy for a study without settings."""
_NAMES = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
"""Names of steps, which become names of folders."""
_BRACES = re.compile(r"\{([^{}]*)\}")
"""A placeholder in a path or in the pattern."""

_Frames = tuple[Annotated[WholeNumber, Field(ge=0)], Annotated[WholeNumber, Field(gt=0)]]
_Name = Annotated[str, Field(pattern=f"^{_NAMES.pattern}$")]
_Side = Literal["left", "right"]


class StepTable(BaseModel):
    """One entry of `[[steps]]`: a command and its settings, which are the arguments of the function of Python."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    paths: ClassVar[tuple[str, ...]] = ()
    """The settings that are files or folders."""

    command: str
    """Name of the command."""
    name: _Name | None = None
    """Name of the step and of the folder of its results; the command by default."""
    frames: _Frames | None = None
    """First frame, and the frame after the last one."""

    @property
    def title(self) -> str:
        """Name of the step."""
        return self.name or self.command

    def given(self) -> dict[str, Any]:
        """Return the settings that are given, by name, in the order of their names."""
        found = self.model_dump(exclude_none=True, exclude={"command", "name"})
        return {key: found[key] for key in sorted(found)}


class CaptureStep(StepTable):
    """The settings of `marey capture`."""

    paths: ClassVar[tuple[str, ...]] = ("start", "keypoints", "person_net", "body")

    command: Literal["capture"]
    cameras: tuple[str, ...] | None = None
    preset: Preset | None = None
    stature: Number | None = None
    leg_length: Number | None = None
    asis_distance: Number | None = None
    start: PathText | None = None
    keypoints: PathText | None = None
    person: int | str | None = None
    person_net: PathText | None = None
    body: PathText | None = None
    fixed_sizes: bool | None = None
    surface_tracks: bool | None = None
    sync: Literal["file", "off"] | None = None
    check: Literal["off"] | None = None
    camera_uncertainty: bool | None = None
    overlay: bool | None = None


class SurfaceStep(StepTable):
    """The settings of `marey surface`."""

    paths: ClassVar[tuple[str, ...]] = ("seeds",)

    command: Literal["surface"]
    cameras: tuple[str, ...] | None = None
    seeds: PathText | None = None
    sync: Literal["file", "off"] | None = None
    spacing: WholeNumber | None = None
    patch: WholeNumber | None = None
    refine_rig: bool | None = None
    tracks: bool | None = None
    max_speed: Number | None = None
    max_acceleration: Number | None = None


class ShapeStep(StepTable):
    """The settings of `marey shape`."""

    paths: ClassVar[tuple[str, ...]] = ("surface", "start", "body")

    command: Literal["shape"]
    surface: PathText | None = None
    """Folder with the surface that a step `surface` measured; without it, it is measured."""
    cameras: tuple[str, ...] | None = None
    preset: Preset | None = None
    stature: Number | None = None
    leg_length: Number | None = None
    asis_distance: Number | None = None
    start: PathText | None = None
    body: PathText | None = None
    overlay: bool | None = None


class MarkersStep(StepTable):
    """The settings of `marey markers`."""

    paths: ClassVar[tuple[str, ...]] = (
        *("file", "reference", "clusters", "static", "functional", "exercise", "exercise_reference", "model"),
        "weights",
    )

    command: Literal["markers"]
    file: PathText | None = None
    """The file with the markers; by default the trial is this file."""
    method: str | tuple[str, ...] | None = None
    reference: PathText | None = None
    clusters: PathText | None = None
    static: PathText | None = None
    functional: tuple[PathText, ...] | None = None
    exercise: PathText | None = None
    exercise_reference: PathText | None = None
    model: PathText | None = None
    weights: PathText | None = None
    fill: str | None = None
    unit: Literal["mm", "cm", "m"] | None = None
    side: _Side | None = None
    marker_set: str | None = None
    person: str | None = None
    measurements: dict[str, Number] | None = None


_MODELS: Mapping[str, type[StepTable]] = {
    "capture": CaptureStep, "surface": SurfaceStep, "shape": ShapeStep, "markers": MarkersStep,
}  # fmt: skip
"""The settings of each command by its name."""
_AnyStep = Annotated[CaptureStep | SurfaceStep | ShapeStep | MarkersStep, Field(discriminator="command")]

class StudySettings(BaseModel):
    """The settings of study.toml."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    pattern: Annotated[str, Field(min_length=1, max_length=1000)] = "*"
    """Where the trials are: a path relative to the study with `*`, `{subject}` and `{condition}`."""
    exclude: tuple[str, ...] = ()
    """Names of trials that do not belong to the study; `*` stands for any characters but a slash."""
    reference: str | None = None
    """The condition with which the others are compared."""
    steps: Annotated[tuple[_AnyStep, ...], Field(min_length=1)]
    """What is done with each trial, in this order."""
    subjects: Mapping[str, Mapping[str, Any]] = Field(default_factory=dict)
    """Settings of all trials of a subject, by its name; they replace those of the steps."""
    trials: Mapping[str, Mapping[str, Any]] = Field(default_factory=dict)
    """Settings of single trials by name, and their `subject` and `condition`; they replace all others."""

    def steps_of(self, trial: str, subject: str) -> Iterator[StepTable]:
        """Yield the steps of a trial with the settings of its subject and its own.

        Args:
            trial: Name of the trial.
            subject: Name of its subject.
        """
        special = {**self.subjects.get(subject, {}), **self.trials.get(trial, {})}
        for step in self.steps:
            own = {key: value for key, value in special.items() if key in _settings_of(step)}
            yield type(step).model_validate({**step.model_dump(exclude_none=True), **own}) if own else step


def _settings_of(step: StepTable) -> frozenset[str]:
    return frozenset(type(step).model_fields) - {"command", "name"}


def read_study(folder: Path) -> StudySettings:
    """Read study.toml and check all of it.

    Args:
        folder: The folder of the study.

    Returns:
        The settings.

    Raises:
        FileProblem: There is none, a key is unknown, or a value is invalid; the message lists all faults.
    """
    path = folder / STUDY_FILE
    if not folder.is_dir():
        wrong = "is a file" if folder.exists() else "does not exist"
        raise FileProblem(folder, wrong, f"Give the folder that holds {STUDY_FILE} and the trials.")
    tables = read_tables(path, _EXAMPLE) if path.exists() else None
    if tables is None:
        raise FileProblem(path, "does not exist", _EXAMPLE)
    try:
        settings = StudySettings.model_validate(tables)
    except ValidationError as error:
        raise FileProblem(path, _faults(error), _known(error)) from error
    faults = list(_more_faults(settings))
    if faults:
        raise FileProblem(path, "; ".join(dict.fromkeys(faults)), "Correct study.toml.")
    return settings


def _more_faults(settings: StudySettings) -> Iterator[str]:
    """Yield what is wrong although every value alone is possible."""
    titles = [step.title for step in settings.steps]
    for title in dict.fromkeys(titles):
        if titles.count(title) > 1:
            yield f"has two steps with the name '{title}', which need a name of their own (name = ...)"
    for name in _BRACES.findall(settings.pattern):
        if name not in FIELDS:
            yield f"has {{{name}}} in the pattern, where only {{subject}} and {{condition}} are known"
    known = {key for step in settings.steps for key in _settings_of(step)}
    for kind, tables, extra in (("subjects", settings.subjects, set()), ("trials", settings.trials, set(FIELDS))):
        for name, table in tables.items():
            for key in sorted(set(table) - known - extra):
                yield f"has the unknown key '{key}' in [{kind}.{name}], which is a setting of no step"
    for step in _every_step(settings):
        if isinstance(step, str):
            yield step
            continue
        for setting, text in path_texts(step):
            for name in _BRACES.findall(text):
                if name not in PLACEHOLDERS:
                    known_names = ", ".join(f"{{{each}}}" for each in PLACEHOLDERS)
                    yield f"has {{{name}}} in {setting} of the step {step.title}, where {known_names} are known"


def _every_step(settings: StudySettings) -> Iterator[StepTable | str]:
    """Yield the steps as the study, each subject and each trial has them; what is wrong in one as text."""
    yield from settings.steps
    for kind, tables in (("subjects", settings.subjects), ("trials", settings.trials)):
        for name, table in tables.items():
            own = {key: value for key, value in table.items() if key not in FIELDS or kind == "subjects"}
            try:
                yield from StudySettings(steps=settings.steps, trials={name: own}).steps_of(name, "")
            except ValidationError as error:
                yield f"{_faults(error)} in [{kind}.{name}]"


def path_texts(step: StepTable) -> Iterator[tuple[str, str]]:
    """Yield the settings of a step that are paths, with each path as it is written."""
    given = step.given()
    for setting in type(step).paths:
        value = given.get(setting, ())
        for text in (value,) if isinstance(value, str) else value:
            yield setting, text


def filled(text: str, names: Mapping[str, str]) -> str:
    """Replace the placeholders of a path.

    Args:
        text: The path as study.toml has it.
        names: The text in place of each placeholder.
    """
    return _BRACES.sub(lambda match: names[match[1]], text)


def _faults(error: ValidationError) -> str:
    """Return the faults that pydantic found as one line of text."""
    clauses: dict[str, None] = {}
    for fault in _own_faults(error):
        place = [part for part in fault["loc"] if part not in _MODELS]
        key = ".".join(str(part + 1) if isinstance(part, int) else part for part in place)
        why = fault["msg"].replace("Input should", "it should").removeprefix("Value error, ")
        if fault["type"] == "extra_forbidden":
            clauses[f"has the unknown key '{key}'"] = None
        elif fault["type"] in ("missing", "too_short"):
            clauses[f"has no {key}"] = None
        elif fault["type"].startswith("union_tag"):
            clauses[f"has a step {key} whose command should be capture, surface, shape or markers"] = None
        else:
            clauses[f"has {key} = {fault['input']!r}, which is invalid ({why[0].lower()}{why[1:]})"] = None
    return "; ".join(clauses)


def _own_faults(error: ValidationError) -> list[ErrorDetails]:
    """Return the faults but that there are no steps because none of them is valid."""
    faults = error.errors()
    own = [fault for fault in faults if (fault["loc"], fault["type"]) != (("steps",), "too_short")]
    return own if any(fault["loc"][0] == "steps" for fault in own) else faults


def _known(error: ValidationError) -> str:
    """Return sentences with the keys that are known where a fault was found."""
    sentences: dict[str, None] = {}
    for fault in _own_faults(error):
        place = fault["loc"]
        if place[:1] != ("steps",):
            sentences[f"The known keys are {', '.join(StudySettings.model_fields)}."] = None
        elif len(place) > 2:
            keys = ", ".join(_MODELS[str(place[2])].model_fields)
            sentences[f"A step {place[2]} has the keys {keys}."] = None
        else:
            sentences[_EXAMPLE] = None
    return " ".join(sentences)
