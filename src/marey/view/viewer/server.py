"""Local web server of the page of `marey view`: the page, the parts of its data, pictures and reports, and no files."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import parse_qs, urlsplit

import numpy as np

from marey.io.video.seek_copy import copies_folder, seek_copy
from marey.view.local_server import JSON_TYPE, LocalHandler, LocalServer
from marey.view.viewer.page import viewer_html
from marey.view.viewer.parts import ViewerParts
from marey.view.viewer.pictures import LARGE_WIDTH, MEMORY_BYTES, CameraPictures, CopyWriter, Requests
from marey.view.viewer.viewed import ViewedTake, ViewerContent

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
        self._writer: CopyWriter | None = None
        self._temporary: TemporaryDirectory[str] | None = None
        super().__init__(_Handler, port)
        if content.take is not None:
            self._open_pictures(content.take)

    def _open_pictures(self, take: ViewedTake) -> None:
        requests, memory = Requests(), MEMORY_BYTES // len(take.clips)
        folder = None if take.copies is None else self._copies_folder(take.copies)
        for name, clip in zip(take.rig.names, take.clips, strict=True):
            copy = None if folder is None else seek_copy(clip, folder, name, LARGE_WIDTH)
            self.pictures.append(CameraPictures(clip, memory, requests, copy))
        self._writer = CopyWriter(self.pictures, requests)

    def _copies_folder(self, wanted: Path) -> Path:
        """Return the wanted folder for the copies, or one that is deleted at the end if that cannot be used."""
        if copies_folder(wanted):
            return wanted
        self._temporary = TemporaryDirectory(prefix="marey-view-", ignore_cleanup_errors=True)
        return Path(self._temporary.name)

    def server_close(self) -> None:
        """Close the server and the videos."""
        super().server_close()
        if self._writer is not None:
            self._writer.close()
        for pictures in self.pictures:
            pictures.close()
        if self._temporary is not None:
            self._temporary.cleanup()


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
