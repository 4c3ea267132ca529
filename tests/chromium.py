"""A driver of a real Chromium for tests of pages, over its debugging pipe; needs no further package."""

import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome-headless-shell")
VARIABLE = "MAREY_CHROMIUM"
"""Environment variable with the path of the program, where it is not found by itself."""
OPTIONS = (
    "--headless=shell", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist", "--disable-background-networking", "--disable-dev-shm-usage", "--hide-scrollbars",
    "--no-first-run", "--remote-debugging-pipe", "about:blank",
)  # fmt: skip
WAIT_S = 30.0


def chromium() -> str | None:
    """Return the path of the program, or None where there is none."""
    given = os.environ.get(VARIABLE)
    return given or next((path for name in NAMES if (path := shutil.which(name))), None)


class Browser:
    """One page in a browser of its own."""

    def __init__(self, program: str, width: int = 1280, height: int = 800):
        self.errors: list[str] = []
        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        own_read, to_browser = os.pipe()
        from_browser, own_write = os.pipe()
        os.set_blocking(from_browser, False)
        options = [
            *OPTIONS[:-1],
            f"--user-data-dir={self._folder.name}",
            f"--window-size={width},{height}",
            OPTIONS[-1],
        ]
        # The browser reads commands from descriptor 3, and writes to 4.
        shell = f'exec "$0" "$@" 3<&{own_read} 4>&{own_write}'
        self._process = subprocess.Popen(
            ["bash", "-c", shell, program, *options], pass_fds=(own_read, own_write), stderr=subprocess.DEVNULL
        )
        os.close(own_read)
        os.close(own_write)
        self._to, self._from, self._held, self._count = to_browser, from_browser, b"", 0
        self._replies: dict[int, dict[str, Any]] = {}
        target = self._send("Target.createTarget", {"url": "about:blank"})
        self._session = self._send("Target.attachToTarget", {"targetId": target["targetId"], "flatten": True})[
            "sessionId"
        ]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def __enter__(self) -> "Browser":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._process.terminate()
        self._process.wait(WAIT_S)
        os.close(self._to)
        os.close(self._from)
        self._folder.cleanup()

    @property
    def process(self) -> int:
        """Number of the browser's process."""
        return self._process.pid

    def open(self, address: str) -> None:
        """Open a page."""
        self.call("Page.navigate", url=address)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the browser's protocol for the page."""
        return self._send(method, parameters, self._session)

    def run(self, script: str) -> Any:
        """Run a script in the page and return its value, that of a promise when it is fulfilled."""
        reply = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in reply:
            raise AssertionError(reply["exceptionDetails"].get("exception", {}).get("description", "error in a script"))
        return reply["result"].get("value")

    def wait(self, condition: str) -> float:
        """Wait until an expression is true, and return how long it took [s]."""
        started = time.perf_counter()
        while not self.run(f"(() => {{ try {{ return !!({condition}); }} catch {{ return false; }} }})()"):
            if time.perf_counter() - started > WAIT_S:
                raise AssertionError(f"not within {WAIT_S:g} s: {condition}; errors of the page: {self.errors}")
            time.sleep(0.005)
        return time.perf_counter() - started

    def press(self, key: str, code: str = "") -> None:
        """Press and release a key."""
        text = key if len(key) == 1 else ""
        for kind in ("keyDown", "keyUp"):
            more = {"text": text} if text and kind == "keyDown" else {}
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=code or key, **more)

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """Send an event of the mouse: `mouseMoved`, `mousePressed`, `mouseReleased` or `mouseWheel`."""
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def picture(self, path: Path) -> None:
        """Save what the page shows as PNG."""
        import base64

        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))

    def _send(self, method: str, parameters: dict[str, Any], session: str | None = None) -> dict[str, Any]:
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters}
        message |= {"sessionId": session} if session else {}
        os.write(self._to, json.dumps(message).encode() + b"\0")
        end = time.perf_counter() + WAIT_S
        while self._count not in self._replies:
            if time.perf_counter() > end:
                raise AssertionError(f"the browser did not answer {method}")
            self._read()
        reply = self._replies.pop(self._count)
        if "error" in reply:
            raise AssertionError(f"{method}: {reply['error']['message']}")
        return reply.get("result", {})

    def _read(self) -> None:
        if not select.select([self._from], [], [], 0.5)[0]:
            return
        self._held += os.read(self._from, 1 << 20)
        *whole, self._held = self._held.split(b"\0")
        for text in whole:
            message = json.loads(text)
            if "id" in message:
                self._replies[message["id"]] = message
            elif message.get("method") == "Runtime.exceptionThrown":
                details = message["params"]["exceptionDetails"]
                self.errors.append(details.get("exception", {}).get("description", details.get("text", "")))
            elif message.get("method") == "Log.entryAdded" and message["params"]["entry"]["level"] == "error":
                self.errors.append(message["params"]["entry"]["text"])
