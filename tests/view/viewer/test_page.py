"""The page of `marey view` in a real Chromium; skipped where there is none (`MAREY_CHROMIUM` names it)."""

import json
import threading
from collections.abc import Iterator

import numpy as np
import pytest
from tests.chromium import VARIABLE, Browser, chromium
from tests.takes import FRAMES
from tests.viewed import FIRST, content

from marey.cameras.camera import Camera
from marey.errors import FileProblem
from marey.view.viewer.server import ViewerServer
from marey.view.viewer.single_file import write_viewer_file

DRAWN = """
new Promise(done => {
  const { scene } = views[0], { gl } = scene, draw = scene.draw;
  scene.draw = (...given) => {
    scene.draw = draw; draw(...given);
    const w = gl.drawingBufferWidth, h = gl.drawingBufferHeight, p = new Uint8Array(4 * w * h), at = [];
    gl.readPixels(0, 0, w, h, gl.RGBA, gl.UNSIGNED_BYTE, p);
    for (let i = 0; i < w * h; i++) if (p[4 * i + 3]) at.push([i % w, h - 1 - Math.floor(i / w)]);
    done([w, h, at]);
  };
  scene.later();
})"""
"""Size of the 3-D view, and the places of all drawn pixels."""
BOX = "(({ left, top, width, height }) => [left, top, width, height])(plots[0].canvas.getBoundingClientRect())"
"""Place of the first plot."""
PROGRAM = chromium()
needs_chromium = pytest.mark.skipif(PROGRAM is None, reason=f"no Chromium; name it in the variable {VARIABLE}")


@pytest.fixture(scope="module")
def pages(tmp_path_factory) -> Iterator[tuple[ViewerServer, Browser]]:
    """Two results side by side, opened in the browser."""
    rng = np.random.default_rng(20060101)
    with (
        ViewerServer(content(rng, tmp_path_factory.mktemp("take"), second=True)) as server,
        Browser(str(PROGRAM)) as browser,
    ):
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        browser.open(server.address)
        browser.wait("views.every(view => view) && pictures.shown.smallFrame >= 0 && plots.length")
        yield server, browser
        server.shutdown()
        thread.join()


@pytest.fixture
def page(pages) -> Iterator[Browser]:
    """The opened page; each test ends without an error in it."""
    _, browser = pages
    browser.run("player.stop(); look(-1); showFrame(0, true)")
    yield browser
    assert browser.errors == []


def picture_is(frame: int) -> str:
    return f"!pictures.waiting && document.body.dataset.picture === '{FIRST + frame}'"


@needs_chromium
def test_keys_go_through_the_frames(page):
    for key, frame in (("ArrowRight", 1), ("ArrowRight", 2), ("ArrowLeft", 1), ("End", FRAMES - 1), ("Home", 0)):
        page.press(key)
        page.wait(f"current === {frame}")
    assert page.run("byId('clock').textContent").startswith(f"frame {FIRST} ")
    page.press("]")
    page.wait("current === 3")
    page.press("[")
    page.press("]")
    page.press("]")
    page.wait("current === 9")


@needs_chromium
def test_it_plays_and_pauses(page):
    page.press(" ", "Space")
    page.wait("player.playing && current > 0")
    page.press(" ", "Space")
    page.wait("!player.playing")
    paused = page.run("current")
    # Several frames at the recorded rate of 30 Hz.
    page.run("new Promise(done => setTimeout(done, 150))")
    assert page.run("current") == paused


@needs_chromium
def test_a_camera_shows_the_picture_of_the_frame_with_the_body_over_it(page):
    page.press("1", "Digit1")
    for frame in (4, 10, 3):
        page.run(f"showFrame({frame}, true)")
        page.wait(picture_is(frame))
        # The picture carries its number as columns, the lowest bit first.
        light = page.run(
            "(() => { const c = byId('picture-1'), p = pictures.picture, made = new OffscreenCanvas(p.width, p.height);"
            "const g = made.getContext('2d'); g.drawImage(p, 0, 0); return Array.from({ length: 8 }, (_, b) =>"
            "g.getImageData(p.width * (2 * b + 1) / 16, p.height / 2, 1, 1).data[0] > 120); })()"
        )
        assert sum(value << bit for bit, value in enumerate(light)) == FIRST + frame
    assert page.run("[0, 1].map(r => byId('stage-' + r).classList.contains('camera'))") == [True, True]
    page.press("0", "Digit0")
    page.wait("camera === -1")


@needs_chromium
def test_the_lens_of_the_page_is_that_of_the_cameras(pages, page, rng):
    points = rng.uniform(-1.2, 1.2, (50, 3))
    for c, camera in enumerate(pages[0].parts.content.take.rig):
        expected = camera.project(points)
        found = page.run(f"{json.dumps(points.tolist())}.map(point => project(cameras[{c}], point))")
        np.testing.assert_allclose(np.array(found, float), expected, atol=1e-6)


@needs_chromium
def test_the_joints_are_drawn_where_the_fisheye_sees_them(pages, page):
    """Each joint is a white disc of 9 px; its middle is where the camera projects the joint, within a pixel."""
    motion, camera = pages[0].parts.content.results[0].shown.motion, pages[0].parts.content.take.rig["cam02"]
    page.run("look(1); showFrame(4, true); for (const what of ['surface', 'floor']) views[0].toggle(what, false)")
    page.wait(picture_is(4))
    width, height, drawn = page.run(DRAWN)
    page.run("for (const what of ['surface', 'floor']) views[0].toggle(what, true)")
    fit = min(width / camera.size[0], height / camera.size[1])
    middle = (np.array([width, height]) - fit * np.array(camera.size)) / 2
    places = np.array(drawn, float) + 0.5
    pinhole = Camera(
        name="", size=camera.size, matrix=camera.matrix, distortion=np.zeros(4),
        camera_from_world=camera.camera_from_world,
    )  # fmt: skip
    joints = motion.joint_centres[4]
    apart = fit * np.linalg.norm(camera.project(joints) - pinhole.project(joints), axis=1)
    assert apart.max() > 10
    for pixel in camera.project(joints):
        near = np.linalg.norm(places - (middle + fit * (pixel + 0.5)), axis=1) < 3
        # A disc of 3 px holds 28 pixels; a shift of 2 px uncovers a sixth of them.
        assert near.sum() >= 26


@needs_chromium
def test_the_pointer_over_a_curve_moves_all_views(page):
    box = page.run(BOX)
    page.mouse("mouseMoved", box[0] + 0.6 * box[2], box[1] + box[3] / 2)
    page.wait("current > 4 && document.body.dataset.frame === String(data.first + current)")
    assert page.run("plots[0].read.textContent")


@needs_chromium
def test_the_second_result_is_shown_over_the_first(page):
    page.run("document.querySelector('#choices input').click()")
    assert page.run("over && byId('stage-1').hidden")
    page.run("document.querySelector('#choices input').click()")
    assert page.run("!over && !byId('stage-1').hidden")


@needs_chromium
def test_a_file_needs_no_server(rng, tmp_path):
    write_viewer_file(tmp_path / "walk.html", content(rng, tmp_path))
    with Browser(str(PROGRAM), 800, 600) as browser:
        browser.open((tmp_path / "walk.html").as_uri())
        browser.wait("views[0] && plots.length")
        browser.run("look(0); showFrame(7, true)")
        browser.wait(picture_is(7))
        assert browser.errors == []


def test_a_file_that_is_no_page_of_the_viewer_is_not_replaced(rng, tmp_path):
    path = tmp_path / "report.html"
    path.write_text("<title>mine</title>")
    with pytest.raises(FileProblem, match="no page of `marey view`"):
        write_viewer_file(path, content(rng, tmp_path))
    assert path.read_text() == "<title>mine</title>"
    (tmp_path / "walk.html").write_text("<title>walk · marey view</title>")
    assert write_viewer_file(tmp_path / "walk.html", content(rng, tmp_path)) == 1
    assert (tmp_path / "walk.html").stat().st_size > 10_000
