"""Local web server of the page of `marey knee outline`, accessible from the same computer only."""

import hmac
import json
import secrets
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

import jinja2

import marey
from marey.errors import MareyError
from marey.view.outline.session import OutlineSession

HOST = "127.0.0.1"
"""Address of the server, accessible from this computer only."""
_LARGEST_REQUEST = 1_000_000
"""Largest accepted request body [bytes]; an outline is far smaller. Chosen by hand."""
_SECRET_BYTES = 16
"""Length of the secret in the address of the page [bytes]; 128 bits cannot be guessed."""
_JSON = "application/json"
"""Content type of requests and responses."""


class OutlineServer(ThreadingHTTPServer):
    """A server bound to the loopback address, which accepts only requests to that address with the secret path.

    Other users of the computer, and pages of other sites, do not know the path. Nothing but the page and its outlines
    is served, and no files.

    Args:
        session: The outlines that are edited.
        port: Port number; 0 for any free port.

    Raises:
        MareyError: The port is in use.
    """

    daemon_threads = True

    def __init__(self, session: OutlineSession, port: int = 0):
        self.session = session
        self.page = _page(session)
        self.root = f"/{secrets.token_urlsafe(_SECRET_BYTES)}"
        try:
            super().__init__((HOST, port), _Handler)
        except OSError as error:
            raise MareyError(f"Port {port} cannot be used ({error.strerror}). Choose another one (--port).") from error

    @property
    def address(self) -> str:
        """URL of the page."""
        return f"http://{HOST}:{self.server_address[1]}{self.root}/"


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    # Nagle's algorithm would delay short responses on a persistent connection by 40 ms.
    disable_nagle_algorithm = True
    wbufsize = -1
    server: OutlineServer

    def do_GET(self) -> None:
        """Respond with the page, a slice, or the stored outlines."""
        if not self._is_ours():
            return
        url = urlsplit(self.path)
        path = url.path.removeprefix(self.server.root)
        if path == "/":
            self._send(200, "text/html; charset=utf-8", self.server.page.encode())
        elif path in ("/slice", "/state", "/interpolated"):
            self._respond(lambda: self._query(path, parse_qs(url.query)))
        else:
            self._send(404, _JSON, b'{"error": "There is no such page."}')

    def do_POST(self) -> None:
        """Execute an action of the page."""
        if not self._is_ours():
            return
        stated = self.headers.get("Content-Length", "0")
        length = int(stated) if stated.isdecimal() and len(stated) < 10 else _LARGEST_REQUEST + 1
        if length > _LARGEST_REQUEST:
            self.close_connection = True
            self._send(413, _JSON, b'{"error": "The request is larger than any outline."}')
            return
        body = self.rfile.read(length)
        # Another site cannot send this content type without a preflight request, which is never granted.
        if self.headers.get("Content-Type", "").split(";")[0] != _JSON:
            self._send(415, _JSON, b'{"error": "Send application/json."}')
            return
        name = urlsplit(self.path).path.removeprefix(self.server.root).strip("/")
        self._respond(lambda: self._execute(name, json.loads(body)))

    def log_message(self, format: str, *args: Any) -> None:
        """Suppress the request log on the terminal."""

    def _is_ours(self) -> bool:
        """Reject requests without the secret, or with another host or origin, which another site may send."""
        port = self.server.server_address[1]
        ours = {f"{HOST}:{port}", f"localhost:{port}"}
        origin = self.headers.get("Origin")
        given = self.path[: len(self.server.root) + 1].encode()
        known = hmac.compare_digest(given, f"{self.server.root}/".encode())
        from_here = origin is None or origin in {f"http://{name}" for name in ours}
        if known and from_here and self.headers.get("Host") in ours:
            return True
        self.close_connection = True
        self._send(403, _JSON, b'{"error": "Open the page at the printed address."}')
        return False

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
            self._send(400, _JSON, json.dumps({"error": str(error)}).encode())
        except (KeyError, TypeError, ValueError, IndexError, RecursionError) as error:
            text = f"The request is invalid ({type(error).__name__}: {error})."
            self._send(400, _JSON, json.dumps({"error": text}).encode())
        else:
            if isinstance(found, bytes):
                self._send(200, "application/octet-stream", found)
            else:
                self._send(200, _JSON, json.dumps(found, separators=(",", ":")).encode())

    def _send(self, status: int, kind: str, body: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        self.end_headers()
        self.wfile.write(body)


def _page(session: OutlineSession) -> str:
    pages = jinja2.Environment(loader=jinja2.PackageLoader("marey.view", "page"), autoescape=True, trim_blocks=True)
    about = json.dumps(session.about()).replace("<", "\\u003c")
    return pages.get_template("outline.html").render(about=about, name=session.name, version=marey.__version__)
