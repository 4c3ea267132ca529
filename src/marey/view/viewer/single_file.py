"""The page of `marey view` as one file that needs neither a server nor a network."""

from collections.abc import Callable
from pathlib import Path

from marey.arrays import Image
from marey.errors import FileProblem
from marey.io.atomic import replacing
from marey.io.pages import is_own_page
from marey.view.viewer.page import viewer_html
from marey.view.viewer.parts import ViewerParts
from marey.view.viewer.pictures import jpeg_of_width
from marey.view.viewer.server import packed_pictures
from marey.view.viewer.viewed import ViewedTake, ViewerContent

MOST_EMBEDDED = 1600
"""Number of pictures in a file at most, of all cameras together: 10 to 30 MB. Chosen by hand."""
_WIDTH, _QUALITY = 640, 70
"""Largest width [px] and JPEG quality of the pictures in a file. Chosen by hand: about 8 kB each."""


def write_viewer_file(path: Path, content: ViewerContent, report: Callable[[int, int], None] | None = None) -> int:
    """Write the page with all of its data and with pictures of the videos.

    Args:
        path: The HTML file.
        content: What the page shows.
        report: Receives the number of frames whose pictures are done, and that of all.

    Returns:
        The step between the frames whose pictures the file contains; 1 if there are none.

    Raises:
        FileProblem: There is such a file that is no page of `marey view`, or a video is damaged.
    """
    if path.exists() and not is_own_page(path):
        raise FileProblem(path, "exists and is no page of `marey view`", "Choose another name, or remove the file.")
    parts, every = ViewerParts(content), 1
    embedded = {name: parts.part(name) for name in parts.names}
    if content.take is not None:
        every = max(1, -(-len(content.results[0]) * len(content.take.clips) // MOST_EMBEDDED))
        embedded |= _pictures(content, content.take, every, report or (lambda done, count: None))
    with replacing(path) as beside:
        beside.write_text(viewer_html(parts, embedded, every), encoding="utf-8")
    return every


def _pictures(
    content: ViewerContent, take: ViewedTake, every: int, report: Callable[[int, int], None]
) -> dict[str, bytes]:
    first, count = content.results[0].first, len(content.results[0])
    found = {}
    streams = [clip.images(range(first, min(first + count, clip.count), every)) for clip in take.clips]
    for frame in range(0, count, every):
        images = [next(stream, None) for stream in streams]
        found[f"pictures/{frame}"] = packed_pictures([_coded(image) for image in images])
        report(frame // every + 1, -(-count // every))
    return found


def _coded(image: Image | None) -> bytes:
    return b"" if image is None else jpeg_of_width(image, _WIDTH, _QUALITY)
