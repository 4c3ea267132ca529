"""Local web server of the page of `marey view`: the page, the parts of its data, pictures and reports, and no files."""

from collections.abc import Sequence
from urllib.parse import parse_qs, urlsplit

import numpy as np

from marey.view.local_server import JSON_TYPE, LocalHandler, LocalServer
from marey.view.viewer.page import viewer_html
from marey.view.viewer.parts import ViewerParts
from marey.view.viewer.pictures import MEMORY_BYTES, CameraPictures, DecodingTurn
from marey.view.viewer.viewed import ViewerContent

MOST_PICTURES = 32
"""Number of frames whose pictures one request returns at most. Chosen by hand."""
_BYTES = "application/octet-stream"
"""Content type of numbers and of several pictures together."""
_HTML = "text/html; charset=utf-8"
"""Content type of pages."""


class ViewerServer(LocalServer):
    """The server of the page.

    Args:
        content: What the page shows.
        port: Port number; 0 for any free port.

    Raises:
        MareyError: The port is in use.
    """

    def __init__(self, content: ViewerContent, port: int = 0):
        self.parts = ViewerParts(content)
        self.page = viewer_html(self.parts)
        self.pictures: list[CameraPictures] = []
        super().__init__(_Handler, port)
        clips = [] if content.take is None else content.take.clips
        turn = DecodingTurn()
        self.pictures = [CameraPictures(clip, MEMORY_BYTES // len(clips), turn) for clip in clips]

    def server_close(self) -> None:
        """Close the server and the videos."""
        super().server_close()
        for pictures in self.pictures:
            pictures.close()


class _Handler(LocalHandler):
    server: ViewerServer

    def do_GET(self) -> None:
        """Respond with the page, a part of its data, pictures, or the report of a run."""
        if not self.is_ours():
            return
        url = urlsplit(self.path)
        kind, _, name = url.path.removeprefix(f"{self.server.root}/").partition("/")
        try:
            if kind == "part":
                self.send(200, _BYTES, self.server.parts.part(name))
            elif kind == "pictures":
                self.send(200, _BYTES, self._pictures(parse_qs(url.query)))
            elif kind == "report":
                self._send_report(int(name))
            elif not kind:
                self.send(200, _HTML, self.server.page.encode())
            else:
                raise KeyError(kind)
        except (KeyError, ValueError, IndexError, OverflowError):
            self.send(404, JSON_TYPE, b'{"error": "There is no such page."}')

    def _send_report(self, number: int) -> None:
        report = self.server.parts.content.results[number].report
        if number < 0 or report is None:
            raise KeyError(number)
        self.send(200, _HTML, report)

    def _pictures(self, query: dict[str, list[str]]) -> bytes:
        """Return the large pictures of a camera in some frames, or without a camera the small ones of all cameras."""
        first, count = (int(query[name][0]) for name in ("first", "count"))
        if not 1 <= count <= MOST_PICTURES or first < 0:
            raise ValueError(count)
        frames, cameras = range(first, first + count), self.server.pictures
        if "camera" in query:
            camera = cameras[[*range(len(cameras))].index(int(query["camera"][0]))]
            return packed_pictures([camera.picture(frame).large for frame in frames])
        # All cameras decode at the same time.
        for frame in frames:
            for camera in cameras:
                camera.want(frame)
        return packed_pictures([camera.picture(frame).small for frame in frames for camera in cameras])


def packed_pictures(coded: Sequence[bytes]) -> bytes:
    """Return pictures one after the other, after their lengths as little-endian 32-bit integers.

    Args:
        coded: The pictures as JPEG; an empty one stands for a missing picture.
    """
    return np.array([len(each) for each in coded], "<u4").tobytes() + b"".join(coded)
