"""Speed of the page of `marey view` in a real Chromium: first picture, seeks, play, and the bytes of its data.

Takes of four cameras are made from the pictures and the motion of a captured take, repeated forwards and backwards;
the video is H.264 with a key picture every 250 frames,
the same one for all cameras, which are decoded separately. Chromium runs without a graphics card on the same processor
as the server; it is found as `chromium`, or named by the variable MAREY_CHROMIUM. Times are read in the page: `first
view` is from the request of the page until the 3-D view and the small pictures of all cameras are drawn, `seek` is
from the choice of a frame until its picture is drawn with the body over it, `longest frame` the longest time between
two frames of the page meanwhile. At first: just after the first start of the server, which then copies the videos with
near key pictures; copied: after that; again: just after another start, which finds the copies.
"""

import argparse
import os
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from tests.chromium import Browser, chromium

from bench.common import program
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.io.video.seek_copy import PIECE_FRAMES
from marey.io.video.video import open_clip
from marey.io.video.video_writer import VideoWriter
from marey.pipelines.viewer.viewer import viewer_content
from marey.view.viewer.server import ViewerServer
from marey.view.viewer.viewed import ViewedBody, ViewedResult, ViewedTake, ViewerContent

BENCH = Bench(
    measures="First picture, seeks and play of the page of `marey view` in Chromium.",
    sources=("src/marey/view/viewer", "src/marey/view/page", "src/marey/io/video/seek_copy.py"),
    minutes=8,
)
TAKES = {"10 s, 1280 x 720": (300, (1280, 720)), "10,000 frames, 640 x 480": (10_000, (640, 480))}
"""By name the number of frames and the size of the pictures [px]."""
SEEKS = 40
"""Seeks per row, to random frames."""
SETTLED_S = 1.0
"""Time that the page gets for what follows the choice of a camera [s]."""
PLAY_S = 6
"""Duration for which the page plays [s]."""

SEEK = """
async frame => {
  const began = performance.now();
  let last = began, longest = 0;
  showFrame(frame, true);
  const drawn = () => !pictures.waiting && document.body.dataset.picture === String(data.first + frame);
  do {
    await new Promise(requestAnimationFrame);
    const now = performance.now();
    longest = Math.max(longest, now - last); last = now;
  } while (!drawn());
  return [last - began, longest];
}"""
"""Choose a frame, and wait for its picture; this time and that of the longest frame meanwhile [ms]."""
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
        Column("copies", "MB", 1),
    )  # fmt: skip
    seeks = run.table(
        "Seeks in the image of a camera", ("take", "state"), Column("median", "ms", 0), Column("95 %", "ms", 0),
        Column("longest", "ms", 0), Column("longest frame", "ms", 0), Column("processor time", "ms", 0),
        note=f"{SEEKS} random frames. The processor time is that of the server and the browser per seek.",
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
    """Open the page twice and measure."""
    random, count = np.random.default_rng(1), len(content.results[0])
    frames = [random.integers(0, count, SEEKS) for _ in range(3)]
    with opened(content, found) as (server, browser):
        time_s = browser.run("performance.now() / 1000")
        parts = server.parts
        data = sum(len(parts.part(each)) for each in parts.names if not each.startswith("curves"))
        choose_camera(browser)
        seeks.row((name, "at first"), *seek(browser, frames[0]))
        wait_for_copies(content)
        seeks.row((name, "copied"), *seek(browser, frames[1]))
        first.row(name, time_s, len(server.page) / 1e3, data / 1e6, copied_mb(content))
    with opened(content, found) as (_, browser):
        choose_camera(browser)
        seeks.row((name, "again"), *seek(browser, frames[2]))
        for view, number in (("camera", 0), ("3-D", -1)):
            browser.run(f"look({number})")
            times = np.array(browser.run(f"({PLAY})({PLAY_S})"))
            play.row((name, view), len(times) / PLAY_S, np.diff(times).max())


@contextmanager
def opened(content: ViewerContent, found: str) -> Iterator[tuple[ViewerServer, Browser]]:
    """Open the page, and wait for its first view."""
    with ViewerServer(content) as server, Browser(found) as browser:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            browser.open(server.address)
            browser.wait("views[0] && pictures.shown.smallFrame >= 0")
            yield server, browser
        finally:
            server.shutdown()
            thread.join()
        if browser.errors:
            raise SystemExit(f"The page reports errors: {browser.errors}")


def choose_camera(browser: Browser) -> None:
    """Choose the first camera, and wait until its image is drawn, which is no seek."""
    browser.run("look(0)")
    browser.wait("!pictures.waiting")
    time.sleep(SETTLED_S)


def seek(browser: Browser, frames: np.ndarray) -> tuple[float, ...]:
    """Seek frames; median, 95 %, longest time, longest frame and processor time [ms]."""
    before = processor_s(browser.process) + time.process_time()
    spent = np.array([browser.run(f"({SEEK})({int(frame)})") for frame in frames])
    used = processor_s(browser.process) + time.process_time() - before
    return (*np.percentile(spent[:, 0], (50, 95, 100)), spent[:, 1].max(), 1e3 * used / len(frames))


def processor_s(process: int) -> float:
    """Return the processor time of a process and of its running children [s]."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK") + sum(processor_s(int(c)) for c in children)


def wait_for_copies(content: ViewerContent) -> None:
    """Wait until all pieces of all copies are written."""
    assert content.take is not None
    pieces = sum(-(-clip.count // PIECE_FRAMES) for clip in content.take.clips)
    while len(list(copies_of(content).glob("*/[0-9]*.piece"))) < pieces:
        time.sleep(1)


def copies_of(content: ViewerContent) -> Path:
    """Return the folder of the copies."""
    assert content.take is not None
    assert content.take.copies is not None
    return content.take.copies


def copied_mb(content: ViewerContent) -> float:
    """Return the size of the copies [MB]."""
    return sum(piece.stat().st_size for piece in copies_of(content).rglob("*.piece")) / 1e6


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
    return ViewerContent(results=[made], take=ViewedTake(rig=take.rig, clips=clips, copies=folder / ".view"))


def there_and_back(start: int, end: int, count: int) -> np.ndarray:
    """Frame numbers from the start to the end, back, and so on."""

    def numbers() -> Iterator[int]:
        while True:
            yield from range(start, end)
            yield from range(end, start, -1)

    return np.array(list(islice(numbers(), count)))
