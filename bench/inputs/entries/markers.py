"""Trials of skin markers: `markers`."""

import numpy as np

from bench.inputs.entries.entry import (
    BadInput,
    archive,
    bad,
    copied,
    cut,
    each,
    folder_at,
    raw,
    rewritten,
    rights,
    swap,
    table,
    text,
)

_TRIAL = "markers walk.c3d --reference frame0.npz -q"
_LANDMARKS = table("person.toml", '[landmarks]\nHJC = ["thigh_01", "thigh_02"]', 1)
_POINTER = '[segments]\nleft_thigh = ["thigh_*"]\n[pointer]\nmarkers = ["shank_01", "shank_02"]\n'
_POINTED = '[pointer.trials]\nleft_LE = "left_LE.c3d"\n'
_OPTIONS = (
    *each(f"{_TRIAL} --method {{}}", ("rigd", "rigd", "rigid"), ("','", "--method"), ("ALL", "ALL")),
    *each(f"{_TRIAL} --frames {{}}", ("9:3", "9:3"), ("90:99", "--frames", "39"), ("x", "--frames")),
    *each(f"{_TRIAL} --fill {{}}", ("linear", "fill", "spline"), ("''", "fill", "spline")),
    *each(f"{_TRIAL} --unit {{}}", ("inch", "unit", "mm"), ("MM", "unit", "mm"), ("''", "unit", "mm")),
    *each(f"{_TRIAL} --side {{}}", ("middle", "side", "left"), ("Left", "side", "left")),
    *each(
        "markers walk.c3d -q --reference {}",
        ("nothing.npz", "nothing.npz"),
        ("note.txt", "note.txt"),
        ("empty", "empty"),
        ("trial", "trial"),
        ("cluster.npz", "cluster.npz"),
        ("walk.c3d", "walk.c3d"),
    ),
    *each(
        "markers walk.c3d -q --clusters {}",
        ("nothing.toml", "nothing.toml"),
        ("note.txt", "note.txt"),
        ("trial", "trial"),
        ("trial/cameras.toml", "cameras.toml"),
    ),
    *each(
        "markers walk.c3d --clusters person.toml -q --static {}",
        ("nothing.c3d", "nothing.c3d"),
        ("note.txt", "note.txt"),
        ("a.mot", "a.mot"),
        change=_LANDMARKS,
        why="with landmarks",
    ),
    *each(
        "markers walk.c3d --clusters person.toml -q --static static.c3d --functional {}",
        ("nothing.c3d", "nothing.c3d"),
        ("note.txt", "note.txt"),
        change=_LANDMARKS,
        why="with landmarks",
    ),
    *each(f"{_TRIAL} --method artefact --exercise {{}}", ("nothing.c3d", "nothing.c3d"), ("note.txt", "note.txt")),
    bad(f"{_TRIAL} --exercise walk.c3d --exercise-reference nothing.npz", "nothing.npz"),
    bad(f"{_TRIAL} --method artefact", "artefact", "--exercise"),
    bad(f"{_TRIAL} --model motion/body.osim", "--model", "--reference"),
    bad(f"{_TRIAL} --static static.c3d", "--reference", "--static"),
    bad(f"{_TRIAL} --functional static.c3d", "--functional", "--static"),
    *each(
        "markers walk.c3d -q --model {}",
        ("nothing.osim", "nothing.osim"),
        ("note.txt", "note.txt"),
        ("tasks.xml", "tasks.xml"),
        ("empty", "empty"),
    ),
    bad(f"{_TRIAL} --weights tasks.xml", "--weights", "--model"),
    bad("markers walk.c3d -q --model motion/body.osim --weights nothing.xml", "nothing.xml"),
    *each(
        "markers walk.c3d -q --marker-set {}",
        ("helen-hayes", "marker_set", "pig-lower"),
        ("''", "marker_set", "pig-lower"),
        ("pig-lower", "walk.c3d", "LASI"),
        ("pig-lower --static nothing.c3d", "nothing.c3d"),
        ("pig-lower --reference frame0.npz", "--marker-set", "--reference"),
        ("pig-lower --clusters person.toml", "person.toml", "segments"),
    ),
    *each("markers walk.c3d -q --person {}", ("Ann", "walk.c3d", "Ann"), ("''", "--person")),
    *each(
        "markers walk.c3d -q --measurements {}",
        ("knee_width_mm", "--measurements", "knee_width_mm"),
        ("knee_width_mm=wide", "--measurements", "wide"),
        ("knee_width_mm=nan", "--measurements", "knee_width_mm"),
        ("knee_width_mm=9", "--measurements", "knee_width_mm = 9"),
        ("knee_width_mm=99,knee_width_mm=98", "--measurements", "twice"),
        ("knee=99", "--measurements", "knee", "knee_width_mm"),
        ("knee_width_mm=99", "--measurements", "known marker set"),
        ("''", "--measurements"),
    ),
    *each(
        "markers walk.c3d -q --clusters {} --static static.c3d",
        ("person.toml", "left_LE.c3d"),
        change=text("person.toml", _POINTER + "tip_mm = 99\n" + _POINTED),
        why="a trial of the pointer that is not there",
    ),
    *each(
        "markers walk.c3d -q --clusters {}",
        ("person.toml", "person.toml", "tip_mm", "pivot"),
        change=text("person.toml", _POINTER + _POINTED),
        why="a pointer without a tip",
    ),
    bad("markers walk.c3d -q --model motion/body.osim --weights motion/body.osim", "body.osim"),
    *each(
        "markers {} --reference frame0.npz -q",
        ("nothing.c3d", "nothing.c3d"),
        ("note.txt", "note.txt"),
        ("empty", "empty"),
        ("trial", "trial"),
        ("mask.png", "mask.png"),
        ("frame0.npz", "frame0.npz"),
        ("a.mot", "a.mot"),
    ),
    bad(f"{_TRIAL} --out walk.c3d", "walk.c3d"),
    bad(f"{_TRIAL} --out .", "inputs"),
    bad(
        f"{_TRIAL} --out locked/sub",
        "locked",
        change=(folder_at("locked"), rights("locked", 0o555)),
        how="user",
        why="locked is read-only",
    ),
    bad(
        f"{_TRIAL} --out out",
        "out/report.html",
        change=text("out/report.html", "mine"),
        kept=("out/.work",),
        why="report.html is the user's",
    ),
)


def _scaled(arrays: dict[str, np.ndarray]) -> None:
    arrays["thigh_rotation"] = 2 * arrays["thigh_rotation"]


def _outside(arrays: dict[str, np.ndarray]) -> None:
    arrays["frame"] = np.array(4000)


def _lost(arrays: dict[str, np.ndarray]) -> None:
    arrays["thigh_origin"] = arrays["shank_origin"] = np.full(3, np.nan)


def _unturned(arrays: dict[str, np.ndarray]) -> None:
    for name in ("thigh", "shank"):
        arrays.pop(f"{name}_rotation")


def _sided(arrays: dict[str, np.ndarray]) -> None:
    arrays["side"] = np.array("middle")


_REFERENCES = tuple(
    bad(_TRIAL, "frame0.npz", shown, change=rewritten("frame0.npz", edit), why=why)
    for why, shown, edit in (
        ("a rotation times 2", "thigh", _scaled),
        ("frame 4000", "4000", _outside),
        ("origins of NaN", "thigh", _lost),
        ("the side `middle`", "side", _sided),
        ("no frame", "frame", lambda arrays: arrays.pop("frame")),
        ("no rotation", "segment", _unturned),
    )
)

_FILES = (
    bad(_TRIAL, "walk.c3d", change=cut("walk.c3d", 400), why="cut in its header"),
    bad(_TRIAL, "walk.c3d", change=cut("walk.c3d", 4000), why="cut in its data"),
    bad(_TRIAL, "walk.c3d", change=cut("walk.c3d", 0), why="empty"),
    bad(_TRIAL, "walk.c3d", change=raw("walk.c3d", b"P" * 5000), why="no C3D"),
    bad(_TRIAL, "walk.c3d", change=raw("walk.c3d", b"\x02\x50" + b"\xff" * 5000), why="a header of 255"),
    bad(_TRIAL, "walk.c3d", change=copied("strange.c3d", "walk.c3d"), why="markers of no segment"),
    bad(_TRIAL, "walk.c3d", change=folder_at("walk.c3d"), why="a folder"),
    bad(
        "markers walk.trc --reference frame0.npz -q",
        "walk.trc",
        change=swap("walk.trc", "PathFileType", "Something"),
        why="another first line",
    ),
    bad(
        "markers walk.trc --reference frame0.npz -q",
        "walk.trc",
        "furlong",
        change=swap("walk.trc", "\tm\t", "\tfurlong\t"),
        why="another unit",
    ),
    bad(
        "markers walk.trc --reference frame0.npz -q",
        "walk.trc",
        change=swap("walk.trc", "\t10\t", "\t900000000\t"),
        why="a wrong number of markers",
    ),
    bad("markers walk.trc --reference frame0.npz -q", "walk.trc", change=cut("walk.trc", 60), why="cut in its header"),
    bad("markers walk.trc --reference frame0.npz -q", "walk.trc", change=cut("walk.trc", 2000), why="cut in a row"),
    bad(
        "markers walk.trc --reference frame0.npz -q",
        "walk.trc",
        change=text("walk.trc", "PathFileType\t4\n", "utf-16"),
        why="UTF-16",
    ),
    bad(
        "markers walk.csv --reference frame0.npz -q",
        "walk.csv",
        change=swap("walk.csv", "time", "t"),
        why="no column of times",
    ),
    bad(
        "markers walk.csv --reference frame0.npz -q",
        "walk.csv",
        change=swap("walk.csv", "_mm", "_ft"),
        why="another unit",
    ),
    bad(
        "markers walk.csv --reference frame0.npz -q",
        "walk.csv",
        change=swap("walk.csv", "thigh_02_x_mm", "thigh_01_x_mm"),
        why="a column twice",
    ),
    bad(
        "markers walk.csv --reference frame0.npz -q",
        "walk.csv",
        change=swap("walk.csv", "0.030,", "0.020,"),
        why="a time twice",
    ),
    bad(
        "markers walk.csv --reference frame0.npz -q",
        "walk.csv",
        change=swap("walk.csv", "0.030,", "soon,"),
        why="a time of letters",
    ),
    bad("markers walk.csv --reference frame0.npz -q", "walk.csv", change=cut("walk.csv", 0), why="empty"),
    bad(
        "markers walk.csv --reference frame0.npz -q",
        "walk.csv",
        change=text("walk.csv", "a;b\n1;2\n"),
        why="semicolons",
    ),
    bad(
        "markers walk.csv --reference frame0.npz -q",
        "walk.csv",
        change=text("walk.csv", "x" * 300000 + "\n1\n"),
        why="a field of 300,000 letters",
    ),
    bad(
        "markers walk.c3d --clusters person.toml --reference frame0.npz -q",
        "person.toml",
        change=text("person.toml", "[person]\nknee_width_mm = 9\n"),
        why="a knee as wide as a finger",
    ),
    bad(
        "markers walk.c3d --clusters person.toml --reference frame0.npz -q",
        "person.toml",
        "arm",
        change=swap("person.toml", 'parent = "thigh"', 'parent = "arm"'),
        why="a joint of no segment",
    ),
    bad(
        "markers walk.c3d --clusters person.toml --reference frame0.npz -q",
        "person.toml",
        "thigh_01",
        change=swap("person.toml", '"shank_01"', '"thigh_01"'),
        why="a marker on two segments",
    ),
    bad(
        "markers walk.c3d --clusters person.toml --reference frame0.npz -q",
        "person.toml",
        "segmnts",
        change=swap("person.toml", "segments", "segmnts"),
        why="an unknown table",
    ),
    bad(
        "markers walk.c3d --clusters person.toml --reference frame0.npz -q",
        "person.toml",
        "mm",
        change=text("person.toml", '[segments]\nthigh = ["thigh_*"]\nshank = ["shank_*"]\n[noise]\nmm = -1\n'),
        why="noise of -1 mm",
    ),
    bad(
        "markers walk.c3d --clusters person.toml --reference frame0.npz -q",
        "person.toml",
        change=text("person.toml", "[segments]\nthigh = 3\n"),
        why="a segment of a number",
    ),
    bad(
        "markers walk.c3d --clusters person.toml --reference frame0.npz -q",
        "../x",
        change=text("person.toml", '[segments]\n"../x" = ["thigh_*"]\nshank = ["shank_*"]\n'),
        why="a segment whose name is a path",
    ),
    bad(
        "markers walk.c3d --clusters person.toml --reference frame0.npz -q",
        "thigh_01",
        change=text("person.toml", '[segments]\nthigh = ["thigh_01"]\nshank = ["shank_*"]\n'),
        why="one marker on a segment",
    ),
    bad(_TRIAL, "frame0.npz", change=archive("frame0.npz", {"frame": 0}), why="no segment"),
    bad(_TRIAL, "frame0.npz", change=cut("frame0.npz", 200), why="half an archive"),
    bad(
        "markers walk.c3d -q --model motion/body.osim --weights tasks.xml",
        "walk.c3d",
        why="a model without these markers",
    ),
    bad(
        "markers walk.c3d -q --model motion/body.osim",
        "body.osim",
        change=cut("motion/body.osim", 3000),
        why="half a model",
    ),
    bad(
        "markers walk.c3d -q --model motion/body.osim --weights tasks.xml",
        "tasks.xml",
        change=swap("tasks.xml", "2.5", "-2.5"),
        why="a negative weight",
    ),
    bad(
        "markers walk.c3d -q --model motion/body.osim --weights tasks.xml",
        "tasks.xml",
        change=swap("tasks.xml", "2.5", "heavy"),
        why="a weight of letters",
    ),
)

ENTRIES: tuple[BadInput, ...] = (*_OPTIONS, *_REFERENCES, *_FILES)
"""The entries."""
