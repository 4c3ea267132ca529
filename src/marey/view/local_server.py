"""Base of the local web servers: accessible from the same computer only, by an address that cannot be guessed."""

import hmac
import secrets
import sys
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from marey.errors import MareyError

HOST = "127.0.0.1"
"""Address of the servers, accessible from this computer only."""
JSON_TYPE = "application/json"
"""Content type of JSON."""
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""What a page may load: its own scripts and styles, and data of its own server; nothing from elsewhere."""
_SECRET_BYTES = 16
"""Length of the secret in the address of the page [bytes]; 128 bits cannot be guessed."""


class LocalServer(ThreadingHTTPServer):
    """A server bound to the loopback address, which accepts only requests to that address with the secret path.

    Other users of the computer, and pages of other sites, do not know the path.

    Args:
        handler: The class that responds to requests.
        port: Port number; 0 for any free port.

    Raises:
        MareyError: The port is in use.
    """

    daemon_threads = True

    def __init__(self, handler: type["LocalHandler"], port: int = 0):
        self.root = f"/{secrets.token_urlsafe(_SECRET_BYTES)}"
        try:
            super().__init__((HOST, port), handler)
        except OSError as error:
            raise MareyError(f"Port {port} cannot be used ({error.strerror}). Choose another one (--port).") from error

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore that the browser has closed a connection; report any other error."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)

    @property
    def address(self) -> str:
        """URL of the page."""
        return f"http://{HOST}:{self.server_address[1]}{self.root}/"


class LocalHandler(BaseHTTPRequestHandler):
    """Response to one request of a `LocalServer`, with the checks and headers that all of them need."""

    protocol_version = "HTTP/1.1"
    # Nagle's algorithm would delay short responses on a persistent connection by 40 ms.
    disable_nagle_algorithm = True
    wbufsize = -1
    server: LocalServer

    def log_message(self, format: str, *args: Any) -> None:
        """Suppress the request log on the terminal."""

    def is_ours(self) -> bool:
        """Reject requests without the secret, or with another host or origin, which another site may send."""
        port = self.server.server_address[1]
        ours = self.accepted_hosts(port)
        origin = self.headers.get("Origin")
        given = self.path[: len(self.server.root) + 1].encode()
        known = hmac.compare_digest(given, f"{self.server.root}/".encode())
        from_here = origin is None or origin in {f"http://{name}" for name in ours}
        if known and from_here and self.headers.get("Host") in ours:
            return True
        self.close_connection = True
        self.send(403, JSON_TYPE, b'{"error": "Open the page at the printed address."}')
        return False

    def accepted_hosts(self, port: int) -> set[str]:
        """Return the names of the server under which it may be addressed.

        Args:
            port: The port of the server.
        """
        return {f"{HOST}:{port}", f"localhost:{port}"}

    def send(self, status: int, kind: str, body: bytes) -> None:
        """Send a response.

        Args:
            status: HTTP status.
            kind: Content type.
            body: The content.
        """
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Content-Security-Policy", _POLICY)
        self.end_headers()
        self.wfile.write(body)
