"""Results that are read again: `compare`, `gait`, `device`, `retarget` and `export`."""

import json
import struct
from typing import Any

from bench.inputs.entries.entry import (
    BadInput,
    Change,
    archive,
    bad,
    copied,
    cut,
    each,
    folder_at,
    gone,
    raw,
    rewritten,
    rights,
    swap,
    table,
    text,
)

_COMPARE = (
    *each(
        "compare a.mot {} -q",
        ("nothing.mot", "nothing.mot: does not exist"),
        ("note.txt", "note.txt"),
        ("empty", "empty"),
        ("trial", "trial"),
        ("knight.glb", "knight.glb"),
        ("mask.png", "mask.png"),
        ("walk.c3d", "--map"),
        ("cluster.npz", "cluster.npz"),
    ),
    *each(
        "compare a.mot b.mot -q --map {}",
        ("nothing.toml", "nothing.toml"),
        ("note.txt", "note.txt"),
        ("trial/cameras.toml", "cameras.toml"),
        ("trial", "trial"),
    ),
    *each(
        "compare a.mot b.mot -q --shift {}",
        ("nan", "--shift"),
        ("inf", "--shift"),
        ("1e9", "--shift"),
        ("99", "--shift"),
    ),
    *each("compare a.mot b.mot -q --clock {}", ("both", "clock", "offset"), ("''", "clock", "offset")),
    bad("compare a.mot b.mot -q --clock rate --shift 0", "--shift"),
    bad("compare a.mot b.mot -q --out .", "inputs"),
    bad("compare a.mot b.mot -q --out a.mot", "a.mot"),
    bad(
        "compare a.mot b.mot -q --out locked/sub",
        "locked",
        change=(folder_at("locked"), rights("locked", 0o555)),
        how="user",
        why="locked is read-only",
    ),
    bad(
        "compare a.mot b.mot -q --map angles.toml",
        "angles.toml",
        "tail",
        change=text("angles.toml", '[angles]\nright_knee_flexion = "tail"\n'),
        why="an angle that is not there",
    ),
    bad(
        "compare a.mot b.mot -q --map angles.toml",
        "angles.toml",
        change=text("angles.toml", "[angles]\nright_knee_flexion = 3\n"),
        why="a number as a name",
    ),
    bad(
        "compare a.mot b.mot -q --map angles.toml",
        "angles.toml",
        "angels",
        change=text("angles.toml", "[angels]\n"),
        why="an unknown table",
    ),
    bad("compare a.mot b.mot -q", "b.mot", change=swap("b.mot", "endheader", "header"), why="no endheader"),
    bad(
        "compare a.mot b.mot -q",
        "b.mot",
        change=swap("b.mot", "inDegrees=yes", "inDegrees=perhaps"),
        why="neither degrees nor radians",
    ),
    bad(
        "compare a.mot b.mot -q", "b.mot", change=swap("b.mot", "nRows=200", "nRows=900"), why="a wrong number of rows"
    ),
    bad(
        "compare a.mot b.mot -q",
        "b.mot",
        change=swap("b.mot", "nColumns=2", "nColumns=99999999999"),
        why="a wrong number of columns",
    ),
    bad("compare a.mot b.mot -q", "b.mot", change=swap("b.mot", "time\t", "zeit\t"), why="no column of times"),
    bad("compare a.mot b.mot -q", "b.mot", change=cut("b.mot", 0), why="empty"),
    bad("compare a.mot b.mot -q", "b.mot", change=cut("b.mot", 40), why="cut in its header"),
    bad("compare a.mot b.mot -q", "b.mot", change=table("b.mot", "3.9\tx", 1), why="a row of letters"),
    bad("compare a.mot b.mot -q", "b.mot", change=table("b.mot", "9.{}\t1\t2", 1), why="a row that is too long"),
    bad("compare a.mot b.mot -q", "b.mot", change=table("b.mot", "1.{}\t1", 3), why="times that go back"),
    bad("compare a.mot b.mot -q", "b.mot", change=text("b.mot", "name\nendheader\n", "utf-16"), why="UTF-16"),
    bad(
        "compare motion other -q",
        "other",
        change=(copied("motion", "other"), gone("other/motion.npz")),
        why="no motion.npz",
    ),
    bad(
        "compare motion other -q",
        "motion.npz",
        change=(copied("motion", "other"), cut("other/motion.npz", 999)),
        why="half a motion.npz",
    ),
    bad(
        "compare motion other -q",
        "motion.npz",
        change=(copied("motion", "other"), archive("other/motion.npz", {"a": 1})),
        why="another archive",
    ),
    bad(
        "compare motion/orientations.sto other.sto -q",
        "other.sto",
        change=(copied("motion/orientations.sto", "other.sto"), cut("other.sto", 200)),
        why="half a STO",
    ),
)

_DEVICE = "device hips.trc forces.csv --match left+right=force -q"
_DEVICES = (
    *each(
        "device hips.trc {} -q",
        ("nothing.csv", "nothing.csv"),
        ("note.txt", "note.txt"),
        ("empty", "empty"),
        ("trial", "trial"),
        ("knight.glb", "knight.glb"),
        ("forces.csv", "no force plates"),
    ),
    *each(
        "device {} forces.csv --match left+right=force -q",
        ("nothing.trc", "nothing.trc"),
        ("note.txt", "note.txt"),
        ("empty_folder", "empty_folder"),
        ("mask.png", "mask.png"),
    ),
    *each(
        "device hips.trc forces.csv -q --match {}",
        ("left", "--match"),
        ("=force", "--match"),
        ("left=weight", "--match"),
        ("middle=force", "middle"),
        ("left=turning:tail", "tail"),
        ("left=acceleration:nose", "nose"),
        ("left=angle:knee", "knee"),
        ("left=force:hip", "--match"),
    ),
    *each(f"{_DEVICE} --within {{}}", ("0", "--within"), ("-1", "--within"), ("nan", "--within")),
    *each(
        "device hips.trc forces.csv -q --events {}",
        ("nothing.csv", "nothing.csv"),
        ("note.txt", "note.txt"),
        ("forces.csv", "forces.csv"),
        ("trial", "trial"),
    ),
    bad(
        "device hips.trc forces.csv -q --events taps.csv",
        "taps.csv",
        change=text("taps.csv", "motion_s,device_s\n1,x\n"),
        why="an instant of letters",
    ),
    bad(
        "device hips.trc forces.csv -q --events taps.csv",
        "taps.csv",
        change=text("taps.csv", "motion_s,device_s\n"),
        why="no event",
    ),
    bad(
        "device hips.trc forces.csv -q --events taps.csv",
        "taps.csv",
        change=text("taps.csv", "a,b\n1,2\n"),
        why="other columns",
    ),
    bad(
        "device hips.trc forces.csv -q --events taps.csv",
        "taps.csv",
        change=text("taps.csv", "motion_s,device_s\nnan,1\n1e300,2\n"),
        why="NaN and 1e300",
    ),
    bad(_DEVICE, "forces.csv", change=text("forces.csv", "time,left,right\n0,1,2\n"), why="one sample"),
    bad(
        _DEVICE,
        "forces.csv",
        change=swap("forces.csv", "time,left,right", "left,right,other"),
        why="no column of times",
    ),
    bad(_DEVICE, "forces.csv", change=swap("forces.csv", "time,left,right", "time,left,left"), why="a column twice"),
    bad(_DEVICE, "forces.csv", change=swap("forces.csv", "0.04,", "0.02,"), why="a time twice"),
    bad(_DEVICE, "forces.csv", change=swap("forces.csv", "0.04,", "soon,"), why="a time of letters"),
    bad(_DEVICE, "forces.csv", change=text("forces.csv", "time,left,right\n0,1,2\n", "utf-16"), why="UTF-16"),
    bad(f"{_DEVICE} --out forces.csv", "forces.csv"),
    bad(
        f"{_DEVICE} --out locked/sub",
        "locked",
        change=(folder_at("locked"), rights("locked", 0o555)),
        how="user",
        why="locked is read-only",
    ),
)


def _glb(document: Any, binary: bytes = b"") -> bytes:
    """Return a GLB with any document."""
    content = json.dumps(document).encode()
    content += b" " * (-len(content) % 4)
    parts = (
        struct.pack("<II", len(content), 0x4E4F534A) + content + struct.pack("<II", len(binary), 0x004E4942) + binary
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts


def _character(**document: Any) -> Change:
    return raw("knight.glb", _glb({"asset": {"version": "2.0"}} | document))


_RETARGET = (
    *each(
        "retarget {} knight.glb -q",
        ("nowhere", "nowhere"),
        ("note.txt", "note.txt"),
        ("empty_folder", "empty_folder"),
        ("cluster.npz", "cluster.npz"),
        ("trial", "trial"),
    ),
    *each(
        "retarget motion {} -q",
        ("nothing.glb", "nothing.glb"),
        ("note.txt", "note.txt"),
        ("empty", "empty"),
        ("empty_folder", "empty_folder"),
        ("mask.png", "mask.png"),
        ("bone.obj", "bone.obj"),
    ),
    *each(
        "retarget motion knight.glb -q --map {}",
        ("nothing.toml", "nothing.toml"),
        ("note.txt", "note.txt"),
        ("trial", "trial"),
        ("angles.toml", "angles.toml"),
    ),
    *each(
        "retarget motion knight.glb -q --out {}",
        ("knight.glb", "knight.glb"),
        ("a.fbx", ".fbx"),
        ("empty_folder", "empty_folder"),
        ("note.txt/a.glb", "note.txt"),
        ("note.txt", "note.txt"),
    ),
    bad(
        "retarget motion knight.glb -q --out locked/a.glb",
        "locked",
        change=(folder_at("locked"), rights("locked", 0o555)),
        how="user",
        why="locked is read-only",
    ),
    bad(
        "retarget motion knight.glb -q --map joints.toml",
        "joints.toml",
        "tail",
        change=text("joints.toml", '[joints]\ntail = "mixamorig:Hips"\n'),
        why="a segment `tail`",
    ),
    bad(
        "retarget motion knight.glb -q --map joints.toml",
        "Tail",
        "left_thigh",
        change=text("joints.toml", '[joints]\nleft_thigh = "Tail"\n'),
        why="a joint that is not there",
    ),
    bad(
        "retarget motion knight.glb -q --map joints.toml",
        "'3'",
        "left_thigh",
        change=text("joints.toml", "[joints]\nleft_thigh = 3\n"),
        why="a number as a name",
    ),
    bad("retarget motion knight.glb -q", "knight.glb", change=cut("knight.glb", 10), why="cut in its header"),
    bad("retarget motion knight.glb -q", "knight.glb", change=cut("knight.glb", 5000), why="cut in its data"),
    bad("retarget motion knight.glb -q", "knight.glb", change=_character(), why="no skin"),
    bad(
        "retarget motion knight.glb -q",
        "knight.glb",
        change=_character(nodes=[{"children": [0]}], skins=[{"joints": [0]}]),
        why="a node that is its own child",
    ),
    bad("retarget motion knight.glb -q", "knight.glb", change=_character(nodes=3), why="nodes is a number"),
    bad(
        "retarget motion knight.glb -q",
        "knight.glb",
        change=_character(nodes=[{}], skins=[{"joints": [7]}]),
        why="a joint without a node",
    ),
    bad(
        "retarget motion knight.glb -q",
        "knight.glb",
        change=_character(
            buffers=[{"byteLength": 10**15}],
            nodes=[{}],
            skins=[{"joints": [0], "inverseBindMatrices": 0}],
            accessors=[{"count": 10**12, "componentType": 5126, "type": "MAT4", "bufferView": 0}],
            bufferViews=[{"buffer": 0, "byteLength": 10**15}],
        ),
        why="arrays of a petabyte",
    ),
    bad("retarget motion knight.gltf -q", "knight.gltf", change=text("knight.gltf", "{"), why="broken JSON"),
    bad(
        "retarget motion knight.gltf -q",
        "knight.gltf",
        change=text(
            "knight.gltf",
            json.dumps(
                {
                    "asset": {"version": "2.0"},
                    "buffers": [{"uri": "../../secret.bin", "byteLength": 4}],
                    "nodes": [{}],
                    "skins": [{"joints": [0]}],
                }
            ),
        ),
        why="a buffer outside of the folder",
    ),
    bad("retarget motion knight.glb -q", "motion.npz", change=cut("motion/motion.npz", 999), why="half a motion.npz"),
    bad(
        "retarget motion knight.glb -q",
        "motion.npz",
        change=rewritten("motion/motion.npz", lambda arrays: arrays.clear()),
        why="no arrays",
    ),
)

_EXPORT = (
    *each(
        "export {} --out dataset",
        ("nowhere", "nowhere"),
        ("note.txt", "note.txt"),
        ("empty_folder", "empty_folder"),
        ("cluster.npz", "cluster.npz"),
    ),
    *each(
        "export motion --out {}",
        ("note.txt", "note.txt"),
        ("trial", "trial"),
        ("note.txt/dataset", "note.txt"),
    ),
    bad(
        "export motion --out locked/dataset",
        "locked",
        change=(folder_at("locked"), rights("locked", 0o555)),
        how="user",
        why="locked is read-only",
    ),
    bad("export motion --out dataset --to xls", "xls"),
    bad("export motion --out dataset --subject a-b", "a-b"),
    bad("export motion --out dataset --task ../walk", "../walk"),
    bad("export motion --out dataset --session ''", "session"),
    bad("export motion --out dataset --run 0", "0"),
    bad("export motion --out scaled --to opensim", "--model"),
    bad("export motion --out dataset --model body.osim", "opensim"),
    bad("export motion --out scaled --to opensim --model body.osim --mass 0", "0 kg"),
    *each(
        "export motion --out scaled --to opensim --model {}",
        ("nowhere.osim", "nowhere.osim"),
        ("note.txt", "note.txt"),
        ("motion", "motion"),
    ),
    bad("export motion --out dataset --forces walk.c3d", "opensim"),
    bad(
        "export motion --out scaled --to opensim --model body.osim",
        "body.osim",
        change=text("body.osim", "<OpenSimDocument Version='40000'><Model name='empty'/></OpenSimDocument>"),
        why="no bodies",
    ),
    bad(
        "export motion --out scaled --to opensim --model body.osim",
        "body.osim",
        change=text("body.osim", "<!DOCTYPE a [<!ENTITY b 'bbbb'>]><Model>&b;</Model>"),
        why="entities",
    ),
    bad("export motion", "--out"),
)

_GAIT = (
    *each(
        "gait {} --references norm -q",
        ("nothing", "nothing: is not a folder"),
        ("note.txt", "note.txt: is not a folder"),
        ("trial", "trial: has no cycles.csv"),
        ("motion", "motion: has no cycles.csv"),
        ("norm/a norm/a", "The same walk is given twice"),
    ),
    *each(
        "gait walk --references {} -q",
        ("nothing", "nothing: is not a folder"),
        ("empty_folder", "empty_folder: has the results of 0 reference walks"),
        ("walk", "walk: has the results of 0 reference walks"),
        ("norm/a", "norm/a: has the results of 1 reference walks"),
    ),
    bad("gait walk -q", "nothing to compare", "--references"),
    bad("gait walk --references norm -q --out walk", "walk"),
    bad("gait walk --references norm -q --out note.txt", "note.txt"),
    bad("gait walk --references norm -q", "events.csv", change=gone("walk/events.csv"), why="no events.csv"),
    bad("gait walk --references norm -q", "cycles.csv", change=cut("walk/cycles.csv", 900), why="half a cycles.csv"),
    bad(
        "gait walk --references norm -q",
        "events.csv",
        change=swap("walk/events.csv", "time_s", "time"),
        why="no column of times",
    ),
    bad(
        "gait walk --references norm -q",
        "norm/b/cycles.csv",
        change=raw("norm/b/cycles.csv", b"\xff\xfe\x00"),
        why="a damaged reference",
    ),
    bad(
        "gait walk --references norm -q",
        "no angle of hips, knees or ankles in common",
        change=swap("walk/cycles.csv", "knee", "nose"),
        why="other angles",
    ),
)

ENTRIES: tuple[BadInput, ...] = (*_COMPARE, *_GAIT, *_DEVICES, *_RETARGET, *_EXPORT)
"""The entries."""
