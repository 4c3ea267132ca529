import http.client
import json
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from marey.errors import FileProblem, MareyError
from marey.io.mr.contours import read_contours, write_contours
from marey.knee.space.volume import Volume, VoxelGrid
from marey.view.outline.server import OutlineServer
from marey.view.outline.session import OutlineSession

pytest.importorskip("skimage")
GRID = VoxelGrid(shape=(9, 60, 64), lps_from_voxel=np.diag([-0.5, -0.5, 3.0, 1.0]))


def made_volume() -> Volume:
    """A bone as a cone of dark marrow."""
    random = np.random.default_rng(4)
    k, j, i = np.meshgrid(*[np.arange(n) for n in GRID.shape], indexing="ij")
    inside = np.hypot(i - 31.0, j - 29.0) < 14.0 + k
    return Volume(intensity=np.where(inside, 20.0, 90.0) + random.normal(0, 5, GRID.shape), grid=GRID)


def anchors(index: int) -> list[list[float]]:
    radius = 14.0 + index
    return [[31 + radius * np.cos(angle), 29 + radius * np.sin(angle)] for angle in (0.3, 1.8, 3.4, 4.8)]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "contours.json"


@pytest.fixture
def server(path: Path) -> Iterator[OutlineServer]:
    with OutlineServer(OutlineSession(made_volume(), path, "knee.nii.gz")) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def response_of(
    server: OutlineServer, path: str, body: object = None, *, root: str | None = None, **headers: str
) -> tuple[int, bytes]:
    path = (server.root if root is None else root) + path
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=20)
    try:
        if body is None:
            connection.request("GET", path, headers=headers)
        else:
            connection.request("POST", path, json.dumps(body), {"Content-Type": "application/json"} | headers)
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def reply_of(server: OutlineServer, path: str, body: object = None) -> dict:
    status, answer = response_of(server, path, body)
    assert status == 200, answer
    return json.loads(answer)


def outlined(server: OutlineServer, index: int) -> dict:
    asking = {"axis": "k", "index": index, "structure": "femur", "anchors": anchors(index)}
    return reply_of(server, "/close", asking)


def test_the_page_is_one_file_that_loads_nothing_from_elsewhere(server: OutlineServer):
    status, page = response_of(server, "/")
    assert status == 200
    assert b"knee.nii.gz" in page
    for foreign in (b"http://", b"https://", b"src=", b"href=", b"@import", b"url("):
        assert foreign not in page


def test_a_slice_is_sent_in_the_range_of_the_volume(server: OutlineServer):
    status, pixels = response_of(server, "/slice?axis=k&index=4")
    assert status == 200
    low, high = server.session.about()["range"]
    grey = low + (high - low) * np.frombuffer(pixels, "<u2").reshape(60, 64) / 65535
    np.testing.assert_allclose(grey, made_volume().intensity[4], atol=(high - low) / 65535)


def test_the_wire_runs_through_the_anchors_to_the_pointer(server: OutlineServer):
    reply_of(server, "/prepare", {"axis": "k", "index": 4, "structure": "femur"})
    first, second, third, _ = anchors(4)
    for way in ([first, second, third], [third, second, first]):
        body = {"axis": "k", "index": 4, "structure": "femur", "anchors": way[:2], "pointer": way[2]}
        found = reply_of(server, "/wire", body)
        assert np.abs(np.array(found["fixed"][0]) - way[0]).max() <= 0.5
        assert np.abs(np.array(found["live"][-1]) - way[2]).max() <= 0.5
        live = np.hypot(*(np.array(found["live"]) - [31, 29]).T)
        assert np.abs(live - 18.0).mean() < 1.0


def test_each_change_is_stored_and_can_be_undone(server: OutlineServer, path: Path):
    state = outlined(server, 4)
    assert len(state["contours"]) == 1
    kept = read_contours(path)
    assert [(each.structure, each.axis, each.index) for each in kept.contours] == [("femur", "k", 4)]
    assert kept.volume == "knee.nii.gz"
    move = {"version": state["version"], "number": 0, "anchor": 1, "point": [31, 40], "keep": False}
    shown = reply_of(server, "/move", move)
    assert np.array_equal(read_contours(path).contours[0].outline, kept.contours[0].outline)
    moved = reply_of(server, "/move", move | {"keep": True})
    assert moved["contours"][0]["outline"] == shown["contour"]["outline"]
    assert not np.array_equal(read_contours(path).contours[0].anchors, kept.contours[0].anchors)
    back = reply_of(server, "/undo", {"axis": "k", "index": 4})
    np.testing.assert_array_equal(read_contours(path).contours[0].outline, kept.contours[0].outline)
    reply_of(server, "/remove", {"version": back["version"], "number": 0})
    assert read_contours(path).contours == ()


def test_anchors_are_set_on_an_outline_and_removed(server: OutlineServer):
    state = outlined(server, 4)
    point = state["contours"][0]["outline"][10]
    more = reply_of(server, "/insert", {"version": state["version"], "number": 0, "point": point})
    assert len(more["contours"][0]["anchors"]) == 5
    fewer = reply_of(server, "/remove_anchor", {"version": more["version"], "number": 0, "anchor": more["anchor"]})
    assert len(fewer["contours"][0]["anchors"]) == 4


def test_between_outlined_slices_outlines_are_interpolated_and_can_be_accepted(server: OutlineServer):
    outlined(server, 2)
    state = outlined(server, 6)
    assert state["slices"] == {"femur": [2, 6]}
    between = reply_of(server, "/interpolated?axis=k&index=4")
    radius = np.hypot(*(np.array(between["femur"][0]) - [31, 29]).T)
    assert np.abs(radius - 18.0).mean() < 1.0
    assert reply_of(server, "/interpolated?axis=k&index=7") == {}
    state = reply_of(server, "/accept", {"axis": "k", "index": 4, "structure": "femur"})
    assert state["slices"] == {"femur": [2, 4, 6]}
    assert reply_of(server, "/interpolated?axis=k&index=4") == {}
    status, answer = response_of(server, "/accept", {"axis": "k", "index": 8, "structure": "femur"})
    assert status == 400
    assert b"This slice has no interpolated outline" in answer


def test_outlining_is_resumed(server: OutlineServer, path: Path):
    outlined(server, 4)
    again = OutlineSession(made_volume(), path, "knee.nii.gz")
    assert len(again.state("k", 4)["contours"]) == 1
    assert again.about()["index"] == 4


def test_a_structure_keeps_to_one_axis(server: OutlineServer):
    outlined(server, 4)
    asking = {"axis": "j", "index": 29, "structure": "femur", "anchors": [[10, 2], [40, 2], [30, 6]]}
    status, answer = response_of(server, "/close", asking)
    assert status == 400
    assert b"across k" in answer


def test_late_and_impossible_requests_are_rejected_and_change_nothing(server: OutlineServer, path: Path):
    state = outlined(server, 4)
    before = path.read_bytes()
    move = {"version": state["version"] - 1, "number": 0, "anchor": 1, "point": [31, 40], "keep": True}
    wrong = [
        ("/move", move), ("/move", {}), ("/close", {"axis": "k", "index": 99, "structure": "femur", "anchors": []}),
        ("/close", {"axis": "k", "index": 4, "structure": "fibula", "anchors": anchors(4)}),
        ("/close", {"axis": "k", "index": 4, "structure": "tibia", "anchors": anchors(4)[:1]}), ("/wires", {}),
    ]  # fmt: skip
    for name, body in wrong:
        status, answer = response_of(server, name, body)
        assert status == 400, name
        assert json.loads(answer)["error"]
    assert response_of(server, "/slice?axis=q&index=1")[0] == 400
    assert response_of(server, "/nowhere")[0] == 404
    assert path.read_bytes() == before


def test_other_sites_and_other_names_are_rejected(server: OutlineServer):
    body = {"axis": "k", "index": 4}
    assert response_of(server, "/", Host="evil.example")[0] == 403
    assert response_of(server, "/undo", body, Origin="http://evil.example")[0] == 403
    assert response_of(server, "/undo", body, **{"Content-Type": "text/plain"})[0] == 415
    for length in ("2000000", "-1", "many", "9" * 5000):
        assert response_of(server, "/undo", body, **{"Content-Length": length})[0] == 413
    assert server.server_address[0] == "127.0.0.1"


@pytest.mark.parametrize("root", ["", "/", "/x", "/" + "a" * 22, "/../.."])
def test_requests_without_the_secret_of_the_address_are_rejected(server: OutlineServer, root: str):
    assert response_of(server, "/", root=root)[0] == 403
    assert response_of(server, "/slice?axis=k&index=4", root=root)[0] == 403
    assert response_of(server, "/undo", {"axis": "k", "index": 4}, root=root)[0] == 403


def test_the_secret_is_new_for_each_server_and_part_of_the_address(server: OutlineServer):
    with OutlineServer(server.session) as other:
        assert other.root != server.root
        assert len(other.root) >= 22
    assert server.address == f"http://127.0.0.1:{server.server_address[1]}{server.root}/"


@pytest.mark.parametrize(
    "address",
    ["/../../etc/passwd", "/contours.json", "/%2e%2e/contours.json", "//etc/passwd", "/slice/../x", "/run.json"],
)
def test_no_file_is_served(server: OutlineServer, address: str):
    assert response_of(server, address)[0] == 404


def test_nested_requests_are_invalid_and_do_not_end_the_server(server: OutlineServer):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=20)
    connection.request("POST", f"{server.root}/undo", b"[" * 100_000, {"Content-Type": "application/json"})
    assert connection.getresponse().status == 400
    connection.close()
    assert response_of(server, "/")[0] == 200


def test_names_are_escaped_in_the_page(path: Path):
    with OutlineServer(OutlineSession(made_volume(), path, "<script>alert(1)</script>.nii")) as server:
        assert "<script>alert" not in server.page
        assert "&lt;script&gt;alert" in server.page


def test_a_taken_port_and_outlines_of_another_volume_are_errors(server: OutlineServer, path: Path):
    with pytest.raises(MareyError, match=r"Choose another one \(--port\)"):
        OutlineServer(server.session, server.server_address[1])
    write_contours(path, [], VoxelGrid(shape=(9, 60, 60), lps_from_voxel=GRID.lps_from_voxel), "")
    with pytest.raises(FileProblem, match="another volume"):
        OutlineSession(made_volume(), path, "knee.nii.gz")
