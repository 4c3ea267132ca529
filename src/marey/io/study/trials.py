"""The trials of a study: the folders or files that its pattern matches."""

import re
import unicodedata
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from marey.errors import FileProblem
from marey.io.study.settings import STUDY_FILE, StudySettings
from marey.wording import listed

_SHOWN = 5
"""Number of names that a message writes out; chosen by hand."""


@dataclass(frozen=True, kw_only=True)
class StudyTrial:
    """One trial of a study."""

    name: str
    """Its path relative to the study with slashes, without the ending of a file."""
    path: Path
    """The folder or file."""
    subject: str
    """The person; the first part of the path if the pattern does not state it."""
    condition: str
    """The condition; empty if the pattern does not state it."""


def find_trials(folder: Path, settings: StudySettings, *, results: Path) -> tuple[StudyTrial, ...]:
    """Find the trials of a study.

    Args:
        folder: The folder of the study.
        settings: The settings of the study.
        results: Folder of the results, in which no trials are searched.

    Returns:
        The trials in the order of their names.

    Raises:
        FileProblem: There is none, two have one name, or study.toml names a subject, trial or condition that none has.
    """
    matching = _pattern(settings.pattern)
    excluded = [re.compile(_with_stars(text)) for text in settings.exclude]
    found = []
    for path in _candidates(folder, settings.pattern):
        relative = path.relative_to(folder).as_posix()
        match = matching.fullmatch(relative)
        name = relative.removesuffix(path.suffix) if path.is_file() else relative
        outside = results.resolve() not in (path.resolve(), *path.resolve().parents)
        if match and outside and not any(each.fullmatch(name) or each.fullmatch(relative) for each in excluded):
            found.append(_trial(name, path, match.groupdict(), settings))
    if not found:
        wrong = f"has no trials: no folder or file has a path like the pattern '{settings.pattern}' of {STUDY_FILE}"
        raise FileProblem(folder, wrong, 'Correct the pattern, for example pattern = "{subject}/{condition}_*".')
    found.sort(key=lambda trial: trial.name)
    _require_different(folder, found)
    _require_known(folder / STUDY_FILE, settings, found)
    return tuple(found)


def _candidates(folder: Path, pattern: str) -> Iterator[Path]:
    """Yield what has the depth of the pattern, and no hidden part."""
    wide = re.sub(r"\{[^{}]*\}", "*", pattern)
    if wide.startswith("/") or ".." in wide.split("/"):
        raise FileProblem(folder / STUDY_FILE, f"has the pattern '{pattern}'", "It should lead into the study.")
    for path in folder.glob(re.sub(r"\*+", "*", wide.strip("/"))):
        if not any(part.startswith(".") for part in path.relative_to(folder).parts) and path.name != STUDY_FILE:
            yield path


def _pattern(text: str) -> re.Pattern[str]:
    """Return the pattern as a regular expression with the names of its fields as groups."""
    known: set[str] = set()

    def group(match: re.Match[str]) -> str:
        name = match[1]
        again = name in known
        known.add(name)
        return f"(?P={name})" if again else f"(?P<{name}>[^/]+?)"

    parts = re.split(r"(\{[^{}]*\}|\*+)", text.strip("/"))
    whole = ["[^/]*" if part.startswith("*") else part if part.startswith("{") else re.escape(part) for part in parts]
    return re.compile(re.sub(r"\{([^{}]*)\}", group, "".join(whole)))


def _with_stars(text: str) -> str:
    return "[^/]*".join(map(re.escape, text.strip("/").split("*")))


def _trial(name: str, path: Path, fields: dict[str, str], settings: StudySettings) -> StudyTrial:
    own = settings.trials.get(name, {})
    subject = own.get("subject", fields.get("subject", name.split("/")[0]))
    return StudyTrial(
        name=name, path=path, subject=str(subject), condition=str(own.get("condition", fields.get("condition", "")))
    )


def _require_different(folder: Path, trials: Iterable[StudyTrial]) -> None:
    """Check that no two trials would have one folder of results, also where capitals do not count."""
    seen: dict[str, StudyTrial] = {}
    for trial in trials:
        other = seen.setdefault(unicodedata.normalize("NFC", trial.name).casefold(), trial)
        if other is not trial:
            both = " and ".join(each.path.relative_to(folder).as_posix() for each in (other, trial))
            raise FileProblem(
                folder, f"has two trials of the name '{trial.name}': {both}",
                "Rename one of them, make the pattern of study.toml narrower, or exclude one.",
            )  # fmt: skip


def _require_known(path: Path, settings: StudySettings, trials: Iterable[StudyTrial]) -> None:
    """Check that every subject, trial and condition that study.toml names exists."""
    trials = list(trials)
    names = {
        "subject": (settings.subjects, [trial.subject for trial in trials]),
        "trial": (settings.trials, [trial.name for trial in trials]),
        "condition": ([settings.reference] if settings.reference else [], [trial.condition for trial in trials]),
    }
    for kind, (given, there) in names.items():
        unknown = [name for name in given if name not in there]
        if unknown:
            known = listed(dict.fromkeys(each or "''" for each in there), most=_SHOWN)
            raise FileProblem(path, f"names the {kind} '{unknown[0]}', which no trial has", f"There are: {known}.")
