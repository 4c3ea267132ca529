"""Tracks, points and videos of deforming surfaces: `nonrigid`."""

import numpy as np

from bench.inputs.entries.entry import BadInput, archive, bad, copied, cut, each, folder_at, rights, text

_POINTS = np.random.default_rng(4).normal(size=(12, 3, 7))
_OPTIONS = (
    *each(
        "nonrigid {} -q",
        ("nothing.npz", "nothing.npz"),
        ("note.txt", "note.txt"),
        ("empty", "empty"),
        ("empty_folder", "empty_folder"),
        ("mask.png", "mask.png"),
        ("frame0.npz", "frame0.npz"),
        ("a.mot", "a.mot"),
        ("nothing.mp4", "nothing.mp4"),
    ),
    *each(
        "nonrigid cluster.npz -q --basis-shapes {}",
        ("0", "basis"),
        ("-1", "basis"),
        ("99", "basis"),
        ("1.5", "--basis-shapes"),
    ),
    *each("nonrigid cluster.npz -q --frames {}", ("9:3", "9:3"), ("90:99", "--frames", "12")),
    *each("nonrigid walk.c3d -q --only {}", ("arm_*", "arm_*"), ("','", "--only")),
    bad("nonrigid walk.c3d -q --only thigh_01", "walk.c3d", "1 points", code=3, kept=("walk_marey",)),
    *each(
        "nonrigid cluster.npz -q --distance {}",
        ("0 99 0.3", "--distance"),
        ("0 0 0.3", "--distance"),
        ("0 1 -1", "--distance"),
        ("0 1 nan", "--distance"),
        ("-1 2 0.3", "--distance"),
        ("0 1", "--distance"),
        ("a b c", "--distance"),
    ),
    *each(
        "nonrigid tracks.npz -q --matrix {}",
        ("1,2", "--matrix"),
        ("a,b,c,d", "--matrix"),
        ("0,0,0,0", "--matrix"),
        ("nan,750,320,240", "--matrix"),
        ("nothing.txt", "nothing.txt"),
        ("note.txt", "note.txt"),
        ("mask.png", "mask.png"),
        ("1,2,3,4,5,6,7,8,9", "--matrix"),
    ),
    *each(
        "nonrigid left.mp4 -q --points {}",
        ("nothing.npz", "nothing.npz"),
        ("note.txt", "note.txt"),
        ("cluster.npz", "cluster.npz"),
    ),
    *each(
        "nonrigid left.mp4 -q --mask {}",
        ("nothing.png", "nothing.png"),
        ("note.txt", "note.txt"),
        ("trial", "trial"),
        ("small.png", "small.png"),
    ),
    *each(
        "nonrigid left.mp4 right.mp4 -q --cameras {}",
        ("nothing.toml", "nothing.toml"),
        ("note.txt", "note.txt"),
        ("trial/cameras.toml", "cameras.toml"),
    ),
    bad("nonrigid left.mp4 left.mp4 -q", "Two videos have the same name"),
    bad("nonrigid left.mp4 small.mp4 right.mp4 -q --points clicked.npz --points clicked.npz", "--points"),
    bad("nonrigid cluster.npz left.mp4 -q", "either videos, or files"),
    bad("nonrigid cluster.npz tracks.npz -q", "cluster.npz"),
    bad("nonrigid cluster.npz -q --points clicked.npz", "--points"),
    bad("nonrigid cluster.npz -q --mask mask.png", "--mask"),
    bad("nonrigid cluster.npz -q --cameras trial/cameras.toml", "--cameras"),
    bad("nonrigid cluster.npz -q --matrix 750,750,320,240", "--matrix"),
    bad("nonrigid cluster.npz -q --scaled", "--scaled"),
    bad("nonrigid tracks.npz -q --only a", "--only"),
    bad("nonrigid cluster.npz -q --out cluster.npz", "cluster.npz"),
    bad("nonrigid cluster.npz -q --out .", "inputs"),
    bad(
        "nonrigid cluster.npz -q --out locked/sub",
        "locked",
        change=(folder_at("locked"), rights("locked", 0o555)),
        how="user",
        why="locked is read-only",
    ),
)

_UNDETERMINED = tuple(
    bad(
        "nonrigid given.npz -q", "given.npz", shown, change=archive("given.npz", arrays), why=why, code=3,
        kept=("given_marey",),
    )
    for why, shown, arrays in (
        ("one frame", "frame", {"points": _POINTS[:1]}),
        ("two points", "point", {"points": _POINTS[..., :2]}),
        ("equal points", "points", {"points": np.ones((12, 3, 7))}),
    )
)  # fmt: skip
_ARRAYS = tuple(
    bad("nonrigid given.npz -q", "given.npz", shown, change=archive("given.npz", arrays), why=why)
    for why, shown, arrays in (
        ("other arrays", "tracks", {"data": [1, 2]}),
        ("tracks and points", "points", {"tracks": np.ones((5, 2, 6)), "points": _POINTS}),
        ("four axes wrong", "tracks", {"tracks": np.ones((2, 5, 3, 6))}),
        ("no frame", "frame", {"points": _POINTS[:0]}),
        ("NaN everywhere", "given.npz", {"tracks": np.full((9, 2, 8), np.nan)}),
        ("infinite", "given.npz", {"tracks": np.full((9, 2, 8), np.inf)}),
        ("text", "tracks", {"tracks": np.full((9, 2, 8), "x")}),
        ("complex", "tracks", {"tracks": np.ones((9, 2, 8), complex)}),
        ("numbers of 1e200", "given.npz", {"tracks": 1e200 * _POINTS[:, :2]}),
        ("pickled objects", "given.npz", {"tracks": np.array([{"a": 1}], dtype=object)}),
        ("a rate of -1", "rate", {"points": _POINTS, "rate": -1}),
        ("edges of points that are not there", "edges", {"points": _POINTS, "edges": [[0, 99]]}),
    )
)

_FILES = (
    bad("nonrigid cluster.npz -q", "cluster.npz", change=cut("cluster.npz", 300), why="half an archive"),
    bad("nonrigid cluster.npz -q", "cluster.npz", change=copied("mask.png", "cluster.npz"), why="a picture"),
    bad("nonrigid left.mp4 -q", "left.mp4", change=copied("note.txt", "left.mp4"), why="text"),
    bad("nonrigid left.mp4 -q", "left.mp4", change=cut("left.mp4", 800), why="half a video"),
    bad(
        "nonrigid left.mp4 -q --points clicked.npz",
        "clicked.npz",
        change=archive("clicked.npz", {"points": [[1.0, 2], [900, 4]], "frame": 0}),
        why="a point outside",
    ),
    bad(
        "nonrigid left.mp4 -q --points clicked.npz",
        "clicked.npz",
        "frame",
        change=archive("clicked.npz", {"points": [[1.0, 2], [9, 4]], "frame": 99}),
        why="frame 99",
    ),
    bad(
        "nonrigid left.mp4 -q --points clicked.npz",
        "clicked.npz",
        change=archive("clicked.npz", {"points": [[1.0, 2, 3]], "frame": 0}),
        why="points in space",
    ),
    bad(
        "nonrigid tracks.npz -q --matrix matrix.txt",
        "matrix.txt",
        change=text("matrix.txt", "1 2 3\n4 5\n"),
        why="rows of other lengths",
    ),
    bad("nonrigid walk.c3d -q", "walk.c3d", change=cut("walk.c3d", 700), why="half a C3D"),
)

ENTRIES: tuple[BadInput, ...] = (*_OPTIONS, *_ARRAYS, *_UNDETERMINED, *_FILES)
"""The entries."""
