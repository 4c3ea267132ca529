"""Images, meshes and activities of knees: `knee segment`, `thickness`, `register`, `animate`, `template`, `outline`."""

from bench.inputs.entries.entry import (
    BadInput,
    bad,
    copied,
    cut,
    document,
    each,
    folder_at,
    gone,
    raw,
    rewritten,
    rights,
    swap,
    text,
)

_VOLUMES = (
    ("nothing.nii.gz", "nothing.nii.gz"),
    ("note.txt", "note.txt"),
    ("empty", "empty"),
    ("empty_folder", "empty_folder"),
    ("trial", "trial"),
    ("mask.png", "mask.png"),
)
_META = "ObjectType = Image\nNDims = 3\nDimSize = {sizes}\nElementType = MET_FLOAT\nElementDataFile = {data}\n"
"""Header of a MetaImage."""
_SEGMENT = (
    *each("knee segment {} -q", *_VOLUMES),
    *each(
        "knee segment knee.nii.gz -q --template {}",
        ("nowhere", "nowhere"),
        ("note.txt", "note.txt"),
        ("empty_folder", "empty_folder"),
        ("trial", "trial"),
    ),
    *each("knee segment knee.nii.gz -q --side {}", ("middle", "side", "left"), ("LEFT", "side", "left")),
    *each(
        "knee segment knee.nii.gz -q --seed {}",
        ("femur 1 2", "--seed"),
        ("fibula 1 2 3", "fibula"),
        ("femur a b c", "--seed"),
        ("femur nan 0 0", "--seed"),
        ("femur 1e9 0 0", "seed"),
        ("femur", "--seed"),
    ),
    *each(
        "knee segment knee.nii.gz -q --seed-voxel {}",
        ("femur 99 0 0", "seed"),
        ("femur -1 0 0", "seed"),
        ("femur 1 2", "--seed-voxel"),
        ("femur nan 0 0", "seed"),
    ),
    bad("knee segment knee.nii.gz -q --seed femur 0 0 3 --seed femur 0 0 4", "femur"),
    bad("knee segment knee.nii.gz knee.nii.gz -q", "knee.nii.gz", code=3, kept=("knee_marey",)),
    bad("knee segment knee.nii.gz series knee.nii.gz -q", "knee"),
    bad("knee segment knee.nii.gz -q --out note.txt", "note.txt"),
    bad("knee segment knee.nii.gz -q --out knee.nii.gz", "knee.nii.gz"),
    bad("knee segment knee.nii.gz -q --out .", "inputs"),
    bad(
        "knee segment knee.nii.gz -q --out locked/sub",
        "locked",
        change=(folder_at("locked"), rights("locked", 0o555)),
        how="user",
        why="locked is read-only",
    ),
    bad("knee segment knee.nii.gz -q", "too small", code=3, kept=("knee_marey",), why="an image of noise"),
    bad("knee segment knee.nii.gz -q", "knee.nii.gz", change=cut("knee.nii.gz", 500), why="half a file"),
    bad("knee segment knee.nii.gz -q", "knee.nii.gz", change=copied("note.txt", "knee.nii.gz"), why="text"),
    bad(
        "knee segment knee.nii -q",
        "knee.nii",
        change=raw("knee.nii", b"\x5c\x01\x00\x00" + b"\x7f" * 348),
        why="sizes of 32639",
    ),
    bad(
        "knee segment knee.nrrd -q",
        "knee.nrrd",
        change=text("knee.nrrd", "NRRD0004\ntype: float\ndimension: 3\nsizes: 90000 90000 90000\nencoding: raw\n\n"),
        why="sizes of 90,000",
    ),
    bad(
        "knee segment knee.nrrd -q",
        "knee.nrrd",
        change=text("knee.nrrd", "NRRD0004\ntype: float\ndimension: 3\nsizes: -4 5 6\nencoding: raw\n\n"),
        why="a negative size",
    ),
    bad(
        "knee segment knee.mha -q",
        "knee.mha",
        change=text(
            "knee.mha",
            _META.format(sizes="90000 90000 90000", data="LOCAL"),
        ),
        why="sizes of 90,000",
    ),
    bad(
        "knee segment knee.mhd -q",
        "other.raw",
        change=text(
            "knee.mhd",
            _META.format(sizes="9 9 9", data="other.raw"),
        ),
        why="no other.raw",
    ),
    bad(
        "knee segment series -q",
        "series",
        change=raw("series/1.2.3_1_97.dcm", b"\x00" * 128 + b"DICM" + b"\xff" * 500),
        why="a slice of 255",
    ),
    bad("knee segment series -q", "series", change=gone("series/1.2.3_1_97.dcm"), why="a slice is missing"),
    bad("knee segment series -q", "series", change=cut("series/1.2.3_1_97.dcm", 700), why="half a slice"),
    bad("knee segment series -q", "series", change=copied("note.txt", "series/1.2.3_1_97.dcm"), why="a slice of text"),
    bad("knee segment series/1.2.3_1_97.dcm -q", "single slice"),
    bad(
        "knee segment knee.nii.gz -q --template atlas",
        "labels.json",
        change=text("atlas/labels.json", "{"),
        why="broken names of labels",
    ),
    bad(
        "knee segment knee.nii.gz -q --template atlas",
        "atlas/labels",
        "femur",
        change=document("atlas/labels.json", {"labels": {"1": "thumb"}}),
        why="an unknown structure",
    ),
    bad(
        "knee segment knee.nii.gz -q --template atlas",
        "atlas",
        change=gone("atlas/labels.json"),
        why="no names of labels",
    ),
    bad(
        "knee segment knee.nii.gz -q --template atlas",
        "labels.nii.gz",
        change=copied("knee.nii.gz", "atlas/labels.nii.gz"),
        why="an image as labels",
    ),
)

_BROKEN = {
    "ply": ("ply\nformat ascii 1.0\nelement vertex 900000000000\nproperty float x\nend_header\n", "element face"),
    "stl": ("solid\nfacet\n", "solid"),
    "vtk": ("# vtk DataFile Version 3.0\nx\nBINARY\nDATASET POLYDATA\nPOINTS 999999999999 float\n", "POINTS"),
    "obj": ("v 1 2\nf 1 2 9\n", "v"),
    "off": ("OFF\n999999999999 1 0\n", "OFF"),
}
"""A broken file of each format of meshes."""
_MESHES = (
    *each(
        "knee thickness {} other.ply",
        ("nothing.ply", "nothing.ply"),
        ("note.txt", "note.txt"),
        ("empty", "empty"),
        ("trial", "trial"),
        ("knee.nii.gz", "knee.nii.gz"),
        ("cluster.npz", "cluster.npz"),
    ),
    *each(
        "knee thickness bone.ply {}", ("nothing.ply", "nothing.ply"), ("note.txt", "note.txt"), ("bone.ply", "bone.ply")
    ),
    *each(
        "knee register {} other.ply -q",
        ("nothing.ply", "nothing.ply"),
        ("note.txt", "note.txt"),
        ("knight.glb", "knight.glb"),
    ),
    *each("knee register bone.ply {} -q", ("nothing.ply", "nothing.ply"), ("note.txt", "note.txt")),
    *(
        bad(
            f"knee thickness broken.{ending} other.ply",
            f"broken.{ending}",
            change=text(f"broken.{ending}", content),
            why=f"a broken {ending.upper()}",
        )
        for ending, (content, _) in _BROKEN.items()
    ),
    *(
        bad(
            f"knee register bone.{ending} other.ply -q",
            f"bone.{ending}",
            change=cut(f"bone.{ending}", 60),
            why=f"the beginning of a {ending.upper()}",
        )
        for ending in ("ply", "stl", "vtk", "glb")
    ),
    bad(
        "knee thickness bone.obj other.ply",
        "bone.obj",
        change=swap("bone.obj", "f 1 3 2", "f 1 3 99"),
        why="a face that points outside",
    ),
    bad(
        "knee thickness bone.obj other.ply",
        "bone.obj",
        change=swap("bone.obj", "v 90.0", "v nan"),
        why="a vertex of NaN",
    ),
    bad(
        "knee thickness bone.obj other.ply",
        "bone.obj",
        change=swap("bone.obj", "v 90.0", "v 1e300"),
        why="a vertex at 1e300",
    ),
    bad("knee thickness bone.ply other.ply --out bone.ply", "bone.ply"),
    bad("knee thickness bone.ply other.ply --out .", "inputs"),
    bad(
        "knee thickness bone.ply other.ply --out locked/sub",
        "locked",
        change=(folder_at("locked"), rights("locked", 0o555)),
        how="user",
        why="locked is read-only",
    ),
    bad("knee register bone.ply other.ply -q --out note.txt", "note.txt"),
    bad("knee register bone.ply other.ply -q --out .", "inputs"),
)

_ACTIVITY = "knee animate activity/knee activity/motion --reference activity/standing.c3d -q"
_ANIMATE = (
    *each(
        "knee animate {} activity/motion -q",
        ("nowhere", "nowhere"),
        ("note.txt", "note.txt"),
        ("empty_folder", "empty_folder"),
        ("trial", "trial"),
    ),
    *each(
        "knee animate activity/knee {} -q",
        ("nowhere", "nowhere"),
        ("note.txt", "note.txt"),
        ("empty_folder", "empty_folder"),
        ("trial", "trial"),
    ),
    *each(
        "knee animate activity/knee activity/motion -q --reference {}",
        ("nothing.c3d", "nothing.c3d"),
        ("note.txt", "note.txt"),
        ("empty", "empty"),
        ("strange.c3d", "strange.c3d"),
    ),
    *each(f"{_ACTIVITY} --method {{}}", ("skin", "skin", "exact"), ("''", "method", "exact")),
    *each(f"{_ACTIVITY} --compare {{}}", ("skin", "skin"), ("nowhere", "nowhere"), ("exact", "exact")),
    *each(f"{_ACTIVITY} --frame {{}}", ("femur", "femur", "tibia"), ("Tibia", "Tibia", "tibia")),
    *each(f"{_ACTIVITY} --view {{}}", ("above", "above", "anterior"), ("','", "--view"), ("''", "--view")),
    *each(
        f"{_ACTIVITY} --limit {{}}",
        ("0", "--limit"),
        ("-1", "--limit"),
        ("nan", "--limit"),
        ("inf", "--limit"),
        ("1e9", "--limit"),
    ),
    *each(f"{_ACTIVITY} --noise {{}}", ("0", "--noise"), ("-1", "--noise"), ("nan", "--noise"), ("1e9", "--noise")),
    *each(
        f"{_ACTIVITY} --landmarks {{}}",
        ("nothing.json", "nothing.json"),
        ("note.txt", "note.txt"),
        ("trial", "trial"),
        ("clicks.json", "clicks.json"),
    ),
    *each(f"{_ACTIVITY} --side {{}}", ("middle", "side", "left")),
    bad(f"{_ACTIVITY} --out note.txt", "note.txt"),
    bad(f"{_ACTIVITY} --out activity/knee", "activity/knee"),
    bad(f"{_ACTIVITY} --out activity/motion", "activity/motion"),
    bad(_ACTIVITY, "markers.json", change=text("activity/knee/markers.json", "{"), why="broken markers"),
    bad(_ACTIVITY, "markers.json", change=gone("activity/knee/markers.json"), why="no markers"),
    bad(
        _ACTIVITY,
        "markers.json",
        change=rewritten("activity/knee/markers.json", lambda tree: tree.update(marker_names=["A"])),
        why="one name for eight markers",
    ),
    bad(
        _ACTIVITY,
        "markers.json",
        change=rewritten("activity/knee/markers.json", lambda tree: tree.update(marker_segment=["thumb"] * 8)),
        why="markers on the thumb",
    ),
    bad(_ACTIVITY, "femur.ply", change=cut("activity/knee/femur.ply", 300), why="half a femur"),
    bad(_ACTIVITY, "activity/knee", change=gone("activity/knee/femur.ply", "activity/knee/tibia.ply"), why="no bones"),
    bad(_ACTIVITY, "bones.npz", change=cut("activity/motion/bones.npz", 900), why="half of bones.npz"),
    bad(_ACTIVITY, "run.json", change=text("activity/motion/run.json", "["), why="a broken run.json"),
    bad(
        _ACTIVITY,
        "marker_motion.csv",
        change=text("activity/motion/marker_motion.csv", "\xff", "latin-1"),
        why="Latin 1",
    ),
    bad(
        f"{_ACTIVITY} --landmarks picked.json",
        "picked.json",
        change=document("picked.json", {"landmarks_lps_mm": {"LE": [1, 2]}}),
        why="a landmark of two numbers",
    ),
)

_OTHERS = (
    *each(
        "knee template {} -q",
        ("nowhere", "nowhere"),
        ("note.txt", "note.txt"),
        ("empty", "empty"),
        ("trial", "trial"),
        ("knee.nii.gz", "knee.nii.gz"),
        ("clicks.json", "clicks.json"),
    ),
    bad("knee template contours.json nothing.nii.gz -q", "nothing.nii.gz"),
    bad("knee template contours.json knee.nii.gz atlas -q", "atlas"),
    bad(
        "knee template contours.json -q",
        "contours.json",
        change=rewritten("contours.json", lambda tree: tree.clear()),
        why="an empty tree",
    ),
    bad("knee template contours.json -q", "contours.json", change=cut("contours.json", 90), why="half a file"),
    bad("knee template contours.json series -q", "contours.json", why="the outlines of another image"),
    bad("knee template atlas -q --out atlas", "atlas"),
    bad("knee template atlas -q --out note.txt", "note.txt"),
    bad(
        "knee template atlas -q",
        "labels",
        change=copied("knee.nii.gz", "atlas/labels.nii.gz"),
        why="an image as labels",
    ),
    *each("knee outline {} -q --no-browser", *_VOLUMES),
    *each(
        "knee outline knee.nii.gz -q --no-browser --port {}", ("-1", "--port"), ("99999", "--port"), ("80.5", "--port")
    ),
    bad("knee outline knee.nii.gz -q --no-browser --out note.txt", "note.txt"),
    bad("knee outline knee.nii.gz -q --no-browser --out empty_folder", "empty_folder"),
    bad("knee outline knee.nii.gz -q --no-browser --out knee.nii.gz", "knee.nii.gz"),
    bad(
        "knee outline series -q --no-browser --out contours.json", "contours.json", why="the outlines of another image"
    ),
)

ENTRIES: tuple[BadInput, ...] = (*_SEGMENT, *_MESHES, *_ANIMATE, *_OTHERS)
"""The entries."""
