import numpy as np

from marey.io.shapes.point_cloud import write_point_cloud


def test_unknown_points_are_omitted_with_their_edges(tmp_path):
    points = np.array([[0.0, 0, 0], [np.nan, 0, 0], [1.0, 2.0, 3.0]])
    colours = np.array([[1, 2, 3], [4, 5, 6], [7, 8, 9]])
    write_point_cloud(tmp_path / "a.ply", points, colours, comment="metres", edges=np.array([[0, 1], [0, 2]]))
    head, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    assert b"comment metres\n" in head
    assert b"element vertex 2\n" in head
    assert b"element edge 1\n" in head
    rows = np.frombuffer(body, [("place", "<f4", 3), ("colour", "u1", 3)], 2)
    assert rows["place"].tolist() == points[[0, 2]].tolist()
    assert rows["colour"].tolist() == colours[[0, 2]].tolist()
    assert np.frombuffer(body[-8:], "<i4").tolist() == [0, 1]
