"""The server of `marey view`: what it serves, to whom, and that pictures are those of their frames."""

import http.client
import threading
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from tests.clips import number_of
from tests.view.viewer.test_pictures import shown, until
from tests.viewed import FIRST, content

from marey.errors import MareyError
from marey.view.viewer.server import MOST_PICTURES, ViewerServer


@pytest.fixture
def server(rng, tmp_path) -> Iterator[ViewerServer]:
    with ViewerServer(content(rng, tmp_path)) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def response_of(server: ViewerServer, path: str, *, root: str | None = None, **headers: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=20)
    try:
        connection.request("GET", (server.root if root is None else root) + path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def pictures_of(body: bytes, count: int) -> list[bytes]:
    lengths = np.frombuffer(body[: 4 * count], "<u4")
    ends = 4 * count + np.cumsum(lengths)
    assert ends[-1] == len(body)
    return [body[end - length : end] for end, length in zip(ends, lengths, strict=True)]


def test_the_page_loads_nothing_from_elsewhere_and_the_report_is_served(server):
    status, page = response_of(server, "/")
    assert status == 200
    for foreign in (b"http://", b"https://", b" src=", b"@import", b"url("):
        assert foreign not in page
    assert response_of(server, "/report/0") == (200, b"<p>report of the run</p>")


@pytest.mark.parametrize("frame", [0, 11, 4])
def test_a_picture_is_that_of_its_frame(server, frame):
    status, body = response_of(server, f"/pictures?first={FIRST + frame}&count=2&camera=1")
    assert status == 200
    coded = pictures_of(body, 2)
    seen = [number_of(cv2.imdecode(np.frombuffer(each, np.uint8), cv2.IMREAD_COLOR)) for each in coded if each]
    assert seen == [n for n in (FIRST + frame, FIRST + frame + 1) if n < 15]


@pytest.mark.parametrize("place", ["result/.view", "file/.view"])
def test_copies_are_kept_beside_the_result_or_else_deleted_at_the_end(rng, tmp_path, monkeypatch, place):
    (tmp_path / "result").mkdir()
    (tmp_path / "temporary").mkdir()
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setattr("marey.view.viewer.pictures._QUIET_S", 0.02)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    given = content(rng, tmp_path)
    clips = [replace(clip, key_frames=10_000) for clip in given.take.clips]
    with ViewerServer(replace(given, take=replace(given.take, clips=clips, copies=tmp_path / place))) as server:
        assert shown(server.pictures[1].picture(9).large) == 9
        until(lambda: len(list(tmp_path.rglob("0000.piece"))) == 2)
    kept = sorted(path.parent.name[:6] for path in tmp_path.rglob("0000.piece"))
    assert kept == (["cam01-", "cam02-"] if place == "result/.view" else [])
    assert list((tmp_path / "temporary").iterdir()) == []


def test_small_pictures_are_of_all_cameras(server):
    coded = pictures_of(response_of(server, "/pictures?first=7&count=2")[1], 4)
    shown = [number_of(cv2.imdecode(np.frombuffer(each, np.uint8), cv2.IMREAD_COLOR)) for each in coded]
    assert shown == [7, 7, 8, 8]


@pytest.mark.parametrize(
    "path",
    [
        "/part/motion/0/99", "/part/motion/0/-1", "/part/../../etc/passwd", "/part/", "/cam01.mp4", "/report/1",
        "/report/-1", "/report/x", "/pictures?first=0", "/pictures?first=-1&count=1", "/pictures?first=0&count=0",
        "/pictures?first=0&count=1&camera=-1", "/pictures?first=0&count=1&camera=2",
        f"/pictures?first=0&count={MOST_PICTURES + 1}", "/pictures?first=1e9&count=1", "/..%2f..%2fetc%2fpasswd",
    ],
)  # fmt: skip
def test_nothing_else_is_served(server, path):
    assert response_of(server, path)[0] == 404


def test_other_hosts_origins_and_paths_are_rejected(server):
    port = server.server_address[1]
    assert response_of(server, "/", root="")[0] == 403
    assert response_of(server, "/", root="/" + "A" * (len(server.root) - 1))[0] == 403
    assert response_of(server, "/", Host="attacker.example")[0] == 403
    assert response_of(server, "/part/curves/0", Origin="http://attacker.example")[0] == 403
    assert response_of(server, "/", Host=f"localhost:{port}", Origin=f"http://localhost:{port}")[0] == 200
    assert server.server_address[0] == "127.0.0.1"


def test_a_port_in_use_is_one_line(rng, tmp_path, server):
    with pytest.raises(MareyError, match=r"Port \d+ cannot be used .*--port"):
        ViewerServer(server.parts.content, server.server_address[1])
