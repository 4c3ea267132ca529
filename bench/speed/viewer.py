"""Speed of the page of `marey view` in a real Chromium: first picture, seeks, play, and the bytes of its data.

Takes of four cameras are made from the pictures and the motion of a captured take, repeated forwards and backwards;
the video is H.264 with a key picture every 250 frames,
the same one for all cameras, which are decoded separately. Chromium runs without a graphics card on the same processor
as the server; it is found as `chromium`, or named by the variable MAREY_CHROMIUM. Times are read in the page: `first
view` is from the request of the page until the 3-D view and the small pictures of all cameras are drawn, `seek` is
from the choice of a frame until its picture is drawn with the body over it. Cold: just after the start of the server;
warm: after it has decoded the videos, as far as its memory allows.
"""

import argparse
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from tests.chromium import Browser, chromium

from bench.common import program
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.io.video.video import open_clip
from marey.io.video.video_writer import VideoWriter
from marey.pipelines.viewer.viewer import viewer_content
from marey.view.viewer.server import ViewerServer
from marey.view.viewer.viewed import ViewedBody, ViewedResult, ViewedTake, ViewerContent

BENCH = Bench(
    measures="First picture, seeks and play of the page of `marey view` in Chromium.",
    sources=("src/marey/view/viewer", "src/marey/view/page"),
    minutes=4,
)
TAKES = {"10 s, 1280 x 720": (300, (1280, 720)), "10,000 frames, 640 x 480": (10_000, (640, 480))}
"""By name the number of frames and the size of the pictures [px]."""
SEEKS = 40
"""Seeks per row, to random frames."""
PLAY_S = 6
"""Duration for which the page plays [s]."""

SEEK = """
async frame => {
  const began = performance.now();
  showFrame(frame, true);
  const drawn = () => !pictures.waiting && document.body.dataset.picture === String(data.first + frame);
  while (!drawn()) await new Promise(requestAnimationFrame);
  return performance.now() - began;
}"""
"""Choose a frame, and wait for its picture [ms]."""
PLAY = """
async seconds => {
  const times = [], seen = new Set(), attribute = camera < 0 ? "frame" : "picture";
  showFrame(0, true); player.play();
  const end = performance.now() + 1000 * seconds;
  while (performance.now() < end) {
    await new Promise(requestAnimationFrame);
    const shown = document.body.dataset[attribute];
    if (!seen.has(shown)) { seen.add(shown); times.push(performance.now()); }
  }
  player.stop();
  return times;
}"""
"""Play, and return when new frames were drawn [ms]."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("take", nargs="?", default="walk", help="of data/people")


def run(run: Run) -> None:
    """Make the takes, and drive the page."""
    found = chromium()
    if found is None:
        raise SystemExit("There is no Chromium. Name the program in the variable MAREY_CHROMIUM.")
    folder, results = program.take(run, run.arguments.take)
    content = viewer_content([results], folder)
    first = run.table(
        "Opening and data", "take", Column("first view", "s", 2), Column("page", "kB", 0), Column("data", "MB", 2),
    )  # fmt: skip
    seeks = run.table(
        "Seeks in the image of a camera", ("take", "state"), Column("median", "ms", 0), Column("95 %", "ms", 0),
        Column("longest", "ms", 0), note=f"{SEEKS} random frames.",
    )  # fmt: skip
    play = run.table(
        "Play at the rate of the take, 30 Hz", ("take", "view"), Column("frames a second", "", 1),
        Column("longest pause", "ms", 0),
    )  # fmt: skip
    for name, (frames, size) in TAKES.items():
        with tempfile.TemporaryDirectory() as place:
            made = repeated(content, frames, size, Path(place))
            drive(name, made, found, first, seeks, play)


def drive(name: str, content: ViewerContent, found: str, first, seeks, play) -> None:
    """Open the page and measure."""
    random = np.random.default_rng(1)
    count = len(content.results[0])
    with ViewerServer(content) as server, Browser(found) as browser:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        browser.open(server.address)
        browser.wait("views[0] && pictures.shown.smallFrame >= 0")
        opened = browser.run("performance.now() / 1000")
        parts = server.parts
        data = sum(len(parts.part(each)) for each in parts.names if not each.startswith("curves"))
        first.row(name, opened, len(server.page) / 1e3, data / 1e6)
        browser.run("look(0)")
        for state in ("cold", "warm"):
            if state == "warm":
                wait_for_pictures(server)
            spent = [browser.run(f"({SEEK})({int(frame)})") for frame in random.integers(0, count, SEEKS)]
            seeks.row((name, state), np.median(spent), np.percentile(spent, 95), max(spent))
        for view, number in (("camera", 0), ("3-D", -1)):
            browser.run(f"look({number})")
            times = np.array(browser.run(f"({PLAY})({PLAY_S})"))
            play.row((name, view), len(times) / PLAY_S, np.diff(times).max())
        server.shutdown()
        thread.join()
        if browser.errors:
            raise SystemExit(f"The page reports errors: {browser.errors}")


def wait_for_pictures(server: ViewerServer) -> None:
    """Wait until the server decodes nothing more in advance."""
    kept = -1
    while kept != (kept := sum(pictures.kept for pictures in server.pictures)):
        time.sleep(2)


def repeated(content: ViewerContent, count: int, size: tuple[int, int], folder: Path) -> ViewerContent:
    """The content with so many frames, forwards and backwards, and videos of a size."""
    result, take = content.results[0], content.take
    body = result.shown
    if take is None or not isinstance(body, ViewedBody):
        raise SystemExit("The take has no videos.")
    known = np.flatnonzero(body.motion.answered)
    order = there_and_back(known[0], known[-1], count)
    path, first = folder / "video.mp4", take.clips[0]
    pictures = [cv2.resize(image, size) for image in first.images(range(result.first, result.first + order.max() + 1))]
    with VideoWriter(path, size, rate=30.0) as video:
        for frame in order:
            video.add(np.asarray(pictures[frame], np.uint8))
    clips = [open_clip(path) for _ in take.clips]
    motion = replace(body.motion.frames(order), time=np.arange(count) / 30.0)
    made = ViewedResult(
        name=result.name, time=motion.time, first=0, state=motion.state, angle_names=motion.angle_names,
        angles_deg=motion.angles_deg, angles_deg_sd=motion.angles_deg_sd,
        shown=ViewedBody(motion=motion, body=body.body),
    )  # fmt: skip
    return ViewerContent(results=[made], take=ViewedTake(rig=take.rig, clips=clips))


def there_and_back(start: int, end: int, count: int) -> np.ndarray:
    """Frame numbers from the start to the end, back, and so on."""

    def numbers() -> Iterator[int]:
        while True:
            yield from range(start, end)
            yield from range(end, start, -1)

    return np.array(list(islice(numbers(), count)))
