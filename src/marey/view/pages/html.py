"""What every page is made of: one template, numbers packed into it, pictures, and how the run went."""

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import jinja2
import numpy as np

import marey
from marey.arrays import Image
from marey.view.pages.problems import readable

MOST_FRAMES = 3000
"""Longer takes are shown by every second, third ... frame, so that the file stays small."""
STILL_WIDTH = 640


@dataclass(frozen=True, eq=False, kw_only=True)
class Still:
    """A picture that is worth a look."""

    caption: str
    image: Image
    """(height, width, 3) blue, green, red."""


class PageContent(Protocol):
    """What every page tells of its run."""

    @property
    def stills(self) -> Sequence[Still]:
        """Pictures, in their order."""

    @property
    def timings(self) -> Mapping[str, float]:
        """Seconds by stage."""

    @property
    def settings(self) -> Mapping[str, object]:
        """What was set, by name."""


def rendered(template: str, content: PageContent, *, data: Mapping[str, object], **more: object) -> str:
    """Fill a template in: one HTML document that loads nothing from elsewhere.

    Args:
        template: Its name.
        content: The template's `content`; its pictures, timings and settings are made ready for reading.
        data: What the page's scripts read.
        more: Further names of the template.
    """
    loader = jinja2.PackageLoader("marey.view", "page")
    pages = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return pages.get_template(template).render(
        content=content,
        version=marey.__version__,
        data=_embedded(data),
        settings=[(readable(k), _setting_text(v)) for k, v in content.settings.items() if v is not None],
        stills=[(still.caption, jpeg_address(still.image)) for still in content.stills],
        timings=_shares(content.timings),
        **more,
    )


def _shares(timings: Mapping[str, float]) -> list[tuple[str, float, float]]:
    """List stages with their seconds and their share of all."""
    total = sum(timings.values())
    return [(name, seconds, seconds / total if total else 0.0) for name, seconds in timings.items()]


def _setting_text(value: object) -> str:
    """Write a setting as people read it."""
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value))
    return {True: "yes", False: "no"}.get(value, str(value)) if isinstance(value, bool) else str(value)


def jpeg_address(image: Image) -> str:
    """Give a picture (height, width, 3), blue, green, red, as the address of an embedded JPEG."""
    height, width = image.shape[:2]
    if width > STILL_WIDTH:
        size = (STILL_WIDTH, round(height * STILL_WIDTH / width))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    _, coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 82])
    return "data:image/jpeg;base64," + base64.b64encode(coded.tobytes()).decode()


def _embedded(data: Mapping[str, object]) -> str:
    """Write data as JSON that may stand inside a script element."""
    return json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")


def packed(array: np.ndarray, dtype: str) -> str:
    """Write an array as text that the page's scripts unpack."""
    return base64.b64encode(np.ascontiguousarray(array, dtype=np.dtype(dtype).newbyteorder("<")).tobytes()).decode()
