"""The HTML of the page of `marey view`, which loads its parts from the server or contains all of them."""

import base64
import json
from collections.abc import Mapping

import jinja2

import marey
from marey.view.viewer.parts import ViewerParts
from marey.view.viewer.plots import side_colours


def viewer_html(parts: ViewerParts, embedded: Mapping[str, bytes] | None = None, every: int = 1) -> str:
    """Return the page.

    Args:
        parts: The data of the page.
        embedded: Parts and pictures by name for a page that needs no server; None for a page of the server.
        every: Step between the frames whose pictures are embedded.
    """
    pages = jinja2.Environment(
        loader=jinja2.PackageLoader("marey.view", "page"), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    results = parts.content.results
    held = None if embedded is None else {name: base64.b64encode(part).decode() for name, part in embedded.items()}
    data = parts.page_data() | {"every": every}
    return pages.get_template("viewer.html").render(
        title=" and ".join(result.name for result in results), results=results, served=embedded is None,
        colours=side_colours(),
        cameras=[] if parts.content.take is None else parts.content.take.rig.names,
        version=marey.__version__, data=_script(data), embedded=_script(held),
    )  # fmt: skip


def _script(value: object) -> str:
    """Return JSON that is safe inside a script element."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")
