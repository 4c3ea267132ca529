"""Local web server of the page of `marey knee outline`, accessible from the same computer only."""

import json
from collections.abc import Callable
from typing import Any
from urllib.parse import parse_qs, urlsplit

import jinja2

import marey
from marey.errors import MareyError
from marey.view.local_server import JSON_TYPE, LocalHandler, LocalServer
from marey.view.outline.session import OutlineSession

_LARGEST_REQUEST = 1_000_000
"""Largest accepted request body [bytes]; an outline is far smaller. Chosen by hand."""


class OutlineServer(LocalServer):
    """The server of the page: nothing but the page and its outlines is served, and no files.

    Args:
        session: The outlines that are edited.
        port: Port number; 0 for any free port.

    Raises:
        MareyError: The port is in use.
    """

    def __init__(self, session: OutlineSession, port: int = 0):
        self.session = session
        self.page = _page(session)
        super().__init__(_Handler, port)


class _Handler(LocalHandler):
    server: OutlineServer

    def do_GET(self) -> None:
        """Respond with the page, a slice, or the stored outlines."""
        if not self.is_ours():
            return
        url = urlsplit(self.path)
        path = url.path.removeprefix(self.server.root)
        if path == "/":
            self.send(200, "text/html; charset=utf-8", self.server.page.encode())
        elif path in ("/slice", "/state", "/interpolated"):
            self._respond(lambda: self._query(path, parse_qs(url.query)))
        else:
            self.send(404, JSON_TYPE, b'{"error": "There is no such page."}')

    def do_POST(self) -> None:
        """Execute an action of the page."""
        if not self.is_ours():
            return
        stated = self.headers.get("Content-Length", "0")
        length = int(stated) if stated.isdecimal() and len(stated) < 10 else _LARGEST_REQUEST + 1
        if length > _LARGEST_REQUEST:
            self.close_connection = True
            self.send(413, JSON_TYPE, b'{"error": "The request is larger than any outline."}')
            return
        body = self.rfile.read(length)
        # Another site cannot send this content type without a preflight request, which is never granted.
        if self.headers.get("Content-Type", "").split(";")[0] != JSON_TYPE:
            self.send(415, JSON_TYPE, b'{"error": "Send application/json."}')
            return
        name = urlsplit(self.path).path.removeprefix(self.server.root).strip("/")
        self._respond(lambda: self._execute(name, json.loads(body)))

    def _query(self, path: str, query: dict[str, list[str]]) -> object:
        axis, index = query["axis"][0], int(query["index"][0])
        session = self.server.session
        if path == "/slice":
            return session.greys(axis, index)
        return session.state(axis, index) if path == "/state" else session.interpolated(axis, index)

    def _execute(self, name: str, arguments: dict[str, Any]) -> object:
        session = self.server.session
        actions: dict[str, Callable[..., object]] = {
            "prepare": session.prepare, "wire": session.wire, "close": session.close, "move": session.move,
            "insert": session.insert, "remove_anchor": session.remove_anchor, "remove": session.remove,
            "accept": session.accept, "undo": session.undo,
        }  # fmt: skip
        return actions[name](**arguments)

    def _respond(self, work: Callable[[], object]) -> None:
        try:
            found = work()
        except MareyError as error:
            self.send(400, JSON_TYPE, json.dumps({"error": str(error)}).encode())
        except (KeyError, TypeError, ValueError, IndexError, RecursionError) as error:
            text = f"The request is invalid ({type(error).__name__}: {error})."
            self.send(400, JSON_TYPE, json.dumps({"error": text}).encode())
        else:
            if isinstance(found, bytes):
                self.send(200, "application/octet-stream", found)
            else:
                self.send(200, JSON_TYPE, json.dumps(found, separators=(",", ":")).encode())


def _page(session: OutlineSession) -> str:
    pages = jinja2.Environment(loader=jinja2.PackageLoader("marey.view", "page"), autoescape=True, trim_blocks=True)
    about = json.dumps(session.about()).replace("<", "\\u003c")
    return pages.get_template("outline.html").render(about=about, name=session.name, version=marey.__version__)
