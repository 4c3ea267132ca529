"""Parts common to all report pages: the template, packed numbers, images, and details of the run."""

import base64
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol
from urllib.parse import quote

import cv2
import jinja2
import numpy as np

import marey
from marey.arrays import Image, Mask
from marey.view.pages.problems import SEVERITIES, Severity, readable

MOST_FRAMES = 3000
"""Number of frames that a page contains at most; longer takes are subsampled. Chosen by hand for small files."""
LONGEST_SUBJECT = 30
"""Largest length of the subject before the colon of a note [characters], by which notes are grouped. Chosen by hand."""
MOST_NOTES = 7
"""Number of reasons, problems and notes that a page lists before its first curve at most; the rest is folded. Chosen by
hand: about half a screen."""
STILL_WIDTH = 640
"""Width [px] to which larger images are reduced; chosen by hand for small files."""


_HEADINGS: Mapping[Severity, str] = {"caution": "Further limits:", "note": "Further notes:"}
"""Headings of reasons that are less grave than those before them."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Still:
    """An image of the page with its caption."""

    caption: str
    image: Image
    """(height, width, 3) blue, green, red."""


@dataclass(frozen=True, kw_only=True)
class PageHead:
    """What the head of a page states about its run."""

    command: str = ""
    """The command, for example `marey capture`."""
    finished: str = ""
    """Date and time of the results."""
    person: str = ""
    """The person that was chosen; empty if there was no choice."""
    verdict: tuple[str, Sequence[str]] | None = None
    """The verdict on the result and its reasons, the gravest first; None without a verdict."""
    grades: Sequence[Severity] = ()
    """How grave each reason is: a problem makes the result not usable, a caution limits its use."""

    @property
    def reasons(self) -> Sequence[str]:
        """The reasons of the verdict, the gravest first; none without a verdict."""
        return self.verdict[1] if self.verdict else ()

    def reason_groups(self, first: int, end: int | None = None) -> list[tuple[str, list[str]]]:
        """Return some of the reasons, those of a kind together, each kind but the gravest with its heading.

        Args:
            first: The number of the first of them.
            end: The number after the last of them; None for all others.
        """
        groups: list[tuple[str, list[str]]] = []
        for k in range(len(self.reasons))[first:end]:
            new = k > 0 and self.grades[k] != self.grades[k - 1]
            if new or not groups:
                groups.append((_HEADINGS[self.grades[k]] if new else "", []))
            groups[-1][1].append(self.reasons[k])
        return groups

    def has_reason(self, text: str) -> bool:
        """Return whether a reason of the verdict contains a text."""
        return any(text in reason for reason in self.reasons)


NO_HEAD = PageHead()
"""Head of a page that states nothing about a run."""


class PageContent(Protocol):
    """Content that every page has."""

    @property
    def head(self) -> PageHead:
        """What the head of the page states about the run."""

    @property
    def stills(self) -> Sequence[Still]:
        """Images in their order."""

    @property
    def timings(self) -> Mapping[str, float]:
        """Duration of each stage [s]."""

    @property
    def settings(self) -> Mapping[str, object]:
        """Settings of the run by name."""

    @property
    def notes(self) -> Sequence[str]:
        """Notes for the reader, one sentence each."""

    @property
    def files(self) -> Mapping[str, str]:
        """Content of the files beside the page, by their names."""


def rendered(
    template: str, content: PageContent, *, data: Mapping[str, object], findings: Sequence[Severity] = (),
    **more: object,
) -> str:  # fmt: skip
    """Render a template as one HTML document that loads nothing from elsewhere.

    Args:
        template: File name of the template.
        content: The template's `content`; its images, timings and settings are formatted.
        data: Data for the scripts of the page.
        findings: How grave each of the findings is that the template lists beside the notes, the gravest first.
        more: Further variables of the template.
    """
    loader = jinja2.PackageLoader("marey.view", "page")
    pages = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    notes = _further_notes(content)
    reasons_shown, findings_shown, notes_shown = gravest(content.head.grades, findings, ["note"] * len(notes))
    return pages.get_template(template).render(
        content=content,
        version=marey.__version__,
        data=_embedded(data),
        settings=[(readable(k), _setting_text(k, v)) for k, v in content.settings.items() if v is not None],
        stills=[(still.caption, jpeg_address(still.image)) for still in content.stills],
        timings=_shares(content.timings),
        links=_links(content.files),
        notes=notes,
        reasons_shown=reasons_shown,
        findings_shown=findings_shown,
        notes_shown=notes_shown,
        **more,
    )


def gravest(*lists: Sequence[Severity]) -> list[int]:
    """Return how many entries of each list are among the gravest of all, `MOST_NOTES` together.

    Args:
        lists: How grave the entries of each list are, the gravest first. Of equal ones, those of earlier lists come
            first.
    """
    ranked = sorted((SEVERITIES.index(grade), k) for k, grades in enumerate(lists) for grade in grades)
    chosen = [k for _, k in ranked[:MOST_NOTES]]
    return [chosen.count(k) for k in range(len(lists))]


def files_beside(files: Mapping[str, str], names: Collection[str]) -> dict[str, str]:
    """Return the files that lie beside a page, with their content.

    Args:
        files: Content by names, separated by commas; `<...>` in a name stands for anything.
        names: Names of all files and folders beside the page; folders may end with a slash.

    Returns:
        Content by the names that exist. `run.json`, which is written last, counts as there.
    """
    there = {name.rstrip("/") for name in names} | {"run.json"}
    found = {}
    for listed, what in files.items():
        own = [each for part in listed.split(", ") for each in _matching(part, there)]
        if own:
            found[", ".join(own)] = what
    return found


def _matching(pattern: str, there: Collection[str]) -> list[str]:
    """Return the names that a pattern stands for; a folder keeps its slash."""
    if "<" not in pattern:
        return [pattern] if pattern.rstrip("/") in there else []
    start, end = pattern.split("<")[0], pattern.split(">")[1]
    return sorted(name for name in there if name.startswith(start) and name.endswith(end))


def _further_notes(content: PageContent) -> list[str]:
    """Return the notes of a page that its verdict does not contain, each once, those on one subject together."""
    groups: dict[str, list[str]] = {}
    for note in dict.fromkeys(content.notes):
        if not content.head.has_reason(note):
            subject, colon, rest = note.partition(": ")
            known = bool(colon) and len(subject) <= LONGEST_SUBJECT
            groups.setdefault(subject if known else note, []).append(rest if known else "")
    return [f"{subject}: {' '.join(rests)}" if rests[0] else subject for subject, rests in groups.items()]


def _links(files: Mapping[str, str]) -> list[tuple[list[tuple[str, str]], str]]:
    """Return for each kind of file beside a page its names with their addresses, and its content."""
    return [([(name, quote(name)) for name in names.split(", ")], what) for names, what in files.items()]


def _shares(timings: Mapping[str, float]) -> list[tuple[str, float, float]]:
    """List the stages with their duration [s] and their share of the total."""
    total = sum(timings.values())
    return [(name, seconds, seconds / total if total else 0.0) for name, seconds in timings.items()]


def _setting_text(name: str, value: object) -> str:
    """Format the value of a setting; `frames` are the first one and the one after the last, as in trial.toml."""
    if isinstance(value, list | tuple):
        if name == "frames" and len(value) == 2:
            return f"{value[0]} to {value[1] - 1}"
        return ", ".join(map(str, value))
    return {True: "yes", False: "no"}.get(value, str(value)) if isinstance(value, bool) else str(value)


def span_of(requested: Mask) -> slice:
    """Return the frames from the first to the last requested one; all without any."""
    frames = np.flatnonzero(requested)
    return slice(int(frames[0]), int(frames[-1]) + 1) if len(frames) else slice(None)


def jpeg_address(image: Image) -> str:
    """Return an image (height, width, 3), blue, green, red, as the data URL of a JPEG."""
    height, width = image.shape[:2]
    if width > STILL_WIDTH:
        size = (STILL_WIDTH, round(height * STILL_WIDTH / width))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    _, coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 82])
    return "data:image/jpeg;base64," + base64.b64encode(coded.tobytes()).decode()


def _embedded(data: Mapping[str, object]) -> str:
    """Format data as JSON that is safe inside a script element."""
    return json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")


def packed(array: np.ndarray, dtype: str) -> str:
    """Encode an array as text (base64, little endian) for the scripts of the page."""
    return base64.b64encode(np.ascontiguousarray(array, dtype=np.dtype(dtype).newbyteorder("<")).tobytes()).decode()
