"""Calibration sessions and calibrations: `calibrate` and `cameras`."""

from bench.inputs.entries.entry import BadInput, bad, copied, cut, document, each, folder_at, gone, swap, text

_BOARDS = tuple(
    bad("calibrate board -q", "board.json", shown, change=change, why=why)
    for why, shown, change in (
        (
            "another type",
            "type",
            document("board/board.json", {"type": "carpet", "columns": 9, "rows": 6, "square_m": 0.1}),
        ),
        ("no type and size", "square_m", document("board/board.json", {"columns": 9, "rows": 6})),
        ("a square of 100 m", "square_m", document("board/board.json", {"columns": 9, "rows": 6, "square_m": 100})),
        ("a square of 0", "square_m", document("board/board.json", {"columns": 9, "rows": 6, "square_m": 0})),
        ("a square of text", "square_m", document("board/board.json", {"columns": 9, "rows": 6, "square_m": "10 cm"})),
        ("half columns", "columns", document("board/board.json", {"columns": 9.5, "rows": 6, "square_m": 0.1})),
        ("negative rows", "rows", document("board/board.json", {"columns": 9, "rows": -6, "square_m": 0.1})),
        ("a million columns", "columns", document("board/board.json", {"columns": 10**6, "rows": 6, "square_m": 0.1})),
        ("an unknown key", "squares_m", document("board/board.json", {"columns": 9, "rows": 6, "squares_m": 0.1})),
        (
            "another dictionary",
            "DICT_9",
            document(
                "board/board.json",
                {"type": "ChArUco", "columns": 9, "rows": 6, "square_m": 0.1, "marker_m": 0.07, "dictionary": "DICT_9"},
            ),
        ),
        (
            "a marker larger than its square",
            "marker_m",
            document(
                "board/board.json",
                {
                    "type": "ChArUco",
                    "columns": 9,
                    "rows": 6,
                    "square_m": 0.1,
                    "marker_m": 0.2,
                    "dictionary": "DICT_5X5_250",
                },
            ),
        ),
        ("a wand of one length 0", "distances_m", document("board/board.json", {"type": "wand", "distances_m": [0]})),
        (
            "a wand of many lengths",
            "distances_m",
            document("board/board.json", {"type": "wand", "distances_m": [1, 2, 3, 4]}),
        ),
        (
            "a wand of another colour",
            "pink",
            document("board/board.json", {"type": "wand", "distances_m": [0.5], "colours": ["pink"]}),
        ),
        ("a list", "board.json", document("board/board.json", [1, 2])),
        ("broken JSON", "line 1", text("board/board.json", '{"columns": 9,')),
        ("an empty file", "board.json", cut("board/board.json", 0)),
        ("UTF-16", "UTF-8", text("board/board.json", "{}", "utf-16")),
        ("NaN", "square_m", text("board/board.json", '{"columns": 9, "rows": 6, "square_m": NaN}')),
    )
)

_SESSIONS = (
    bad("calibrate nowhere -q", "nowhere"),
    bad("calibrate note.txt -q", "note.txt"),
    bad("calibrate empty_folder -q", "empty_folder"),
    bad("calibrate board -q", "board.json", change=gone("board/board.json"), why="no board.json"),
    bad("calibrate board -q", "cam01", change=copied("note.txt", "board/cam01_1.png"), why="a picture is text"),
    bad(
        "calibrate board -q",
        "cam01_1.png",
        change=copied("small.png", "board/cam01_1.png"),
        why="a picture of another size",
    ),
    bad("calibrate board -q", "board", why="pictures without a board"),
    bad(
        "calibrate board -q",
        "board",
        change=gone("board/cam02_0.png", "board/cam02_1.png", "board/cam02_2.png"),
        why="one camera",
    ),
    *each(
        "calibrate board -q --board {}",
        ("nothing.json", "nothing.json"),
        ("note.txt", "note.txt"),
        ("empty", "empty"),
        ("trial", "trial"),
        ("mask.png", "mask.png"),
    ),
    *each(
        "calibrate board -q --points {}",
        ("nothing.json", "nothing.json"),
        ("note.txt", "note.txt"),
        ("empty_folder", "empty_folder"),
        ("clicks.json", "clicks.json"),
    ),
    *each(
        "calibrate board -q --floor {}",
        ("never", "--floor", "never"),
        ("-1", "--floor"),
        ("9:3", "--floor"),
        ("1.5", "--floor"),
    ),
    *each("calibrate board -q --rate {}", ("0", "rate"), ("-1", "rate"), ("nan", "rate"), ("inf", "rate")),
    *each(
        "calibrate board -q --distance {}",
        ("cam01=3", "--distance"),
        ("cam01:cam02", "--distance"),
        ("cam01:cam02=-1", "--distance"),
        ("cam01:cam02=nan", "--distance"),
        ("cam01:cam02=inf", "--distance"),
        ("cam01:cam09=3", "cam09"),
        ("cam01:cam01=3", "cam01"),
    ),
    bad("calibrate board -q --stature 1.8", "--stature", "--from-person"),
    bad("calibrate board -q --cameras cam01", "--cameras", "--from-person"),
    bad("calibrate board -q --frames 0:3", "--frames", "--from-person"),
    bad("calibrate board -q --focal 900", "--focal", "--from-keypoints"),
    bad("calibrate board -q --world-only", "--world-only", "--from-keypoints"),
    bad("calibrate board -q --keep-scale", "--keep-scale", "--world-only"),
    bad("calibrate trial -q --from-person --world-only --focal 900", "--focal", "--from-keypoints"),
    bad("calibrate trial -q --from-person --world-only --out trial", "trial", "--out"),
    bad("calibrate trial -q --from-person --board board/board.json", "--board", "--from-person"),
    bad("calibrate trial -q --from-person --frames 9:3", "9:3"),
    bad("calibrate trial -q --from-person --stature nan", "--stature"),
    bad("calibrate trial -q --from-person --keypoints nothing", "nothing"),
    bad("calibrate nowhere -q --from-person", "nowhere: does not exist"),
    bad("calibrate trial -q --from-person --from-keypoints pose", "--from-person", "--from-keypoints"),
    bad("calibrate trial -q --from-keypoints nothing", "nothing"),
    bad("calibrate trial -q --from-keypoints note.txt", "note.txt"),
    bad("calibrate trial -q --from-keypoints empty_folder", "empty_folder"),
    *each(
        "calibrate trial -q --from-keypoints pose --focal {}",
        ("x", "--focal"),
        ("0", "--focal"),
        ("-900", "--focal"),
        ("nan", "--focal"),
        ("1e300", "--focal"),
        ("cam01=900,900", "--focal"),
        ("cam09=900", "cam09"),
        ("cam01=900,cam01=901", "cam01"),
    ),
    bad("calibrate trial -q --from-keypoints pose --world-only --focal 900", "--focal"),
    bad("calibrate trial -q --from-keypoints pose --stature 0", "--stature"),
    bad("calibrate board -q --out note.txt", "note.txt"),
    bad("calibrate board -q --out board", "board"),
)

_COLMAP = {
    "colmap/cameras.txt": "1 OPENCV 64 48 60 60 32 24 0 0 0 0\n",
    "colmap/images.txt": "1 1 0 0 0 0 0 3 1 cam01.jpg\n\n",
}
"""A model of COLMAP with one camera."""


def _colmap(name: str, old: str, new: str) -> list:  # type: ignore[type-arg]
    files = dict(_COLMAP)
    files[f"colmap/{name}.txt"] = files[f"colmap/{name}.txt"].replace(old, new)
    return [text(path, content) for path, content in files.items()]


_MATRIX = '%YAML:1.0\n---\nnames:\n   - "1"\nK_1: !!opencv-matrix\n   rows: {}\n   cols: 3\n   dt: d\n   data: [1, 2]\n'
"""A calibration of OpenCV whose matrix has some number of rows."""
_OTHERS = (
    *each(
        "cameras {}",
        ("nowhere", "nowhere"),
        ("note.txt", "note.txt"),
        ("empty_folder", "empty_folder"),
        ("mask.png", "mask.png"),
        ("board", "board"),
    ),
    *each(
        "cameras trial --scale {}",
        ("0", "--scale"),
        ("-1", "--scale"),
        ("nan", "--scale"),
        ("inf", "--scale"),
        ("1e300", "--scale"),
    ),
    bad("cameras trial --to pose2sim", "--out", kept=("//",)),
    bad("cameras trial --out new.toml", "--to", kept=("//",)),
    bad("cameras trial --to theia --out new.toml", "theia", "pose2sim", kept=("//",)),
    bad("cameras trial --to pose2sim --out trial/cameras.toml", "cameras.toml", kept=("//",)),
    bad("cameras trial --to pose2sim --out note.txt/new.toml", "note.txt", kept=("//",)),
    bad("cameras trial --to opencv --out note.txt", "--out", kept=("//",)),
    *(
        bad(
            "cameras project",
            "intri.yml",
            change=(text("project/intri.yml", content), text("project/extri.yml", '%YAML:1.0\n---\nnames:\n  - "1"\n')),
            why=why,
        )
        for why, content in (
            ("an empty intri.yml", ""),
            ("no names", "%YAML:1.0\n---\nK_1: 3\n"),
            (
                "a matrix of -3 rows",
                _MATRIX.format(-3),
            ),
            (
                "a matrix of 10^9 rows",
                _MATRIX.format(1000000000),
            ),
        )
    ),
    bad("cameras lab.xcp", "lab.xcp", change=text("lab.xcp", "<Cameras>"), why="broken XML"),
    bad("cameras lab.xcp", "lab.xcp", change=text("lab.xcp", "<Cameras></Cameras>"), why="no camera"),
    bad(
        "cameras lab.xcp",
        "lab.xcp",
        change=text("lab.xcp", '<!DOCTYPE a [<!ENTITY b "bb">]><Cameras>&b;</Cameras>'),
        why="an entity",
    ),
    bad(
        "cameras lab.qca.txt",
        "lab.qca.txt",
        change=text("lab.qca.txt", "<?xml version='1.0' encoding='klingon'?><calibration/>"),
        why="an unknown encoding",
    ),
    bad(
        "cameras lab.qca.txt",
        "lab.qca.txt",
        change=text("lab.qca.txt", "<calibration><cameras></cameras></calibration>"),
        why="no camera",
    ),
    bad("cameras colmap", "cameras.txt", change=_colmap("cameras", "OPENCV", "UNKNOWN"), why="an unknown lens"),
    bad("cameras colmap", "cameras.txt", change=_colmap("cameras", "60 60", "x 60"), why="a focal length of text"),
    bad("cameras colmap", "images.txt", change=_colmap("images", "1 0 0 0", "0 0 0 0"), why="a rotation of 0"),
    bad("cameras colmap", "images.txt", change=_colmap("images", "3 1", "3 7"), why="a camera that is not there"),
    bad("cameras colmap", "images.txt", change=_colmap("images", "cam01.jpg", ""), why="no name"),
    bad(
        "cameras cam.pickle",
        "cam.pickle",
        change=text("cam.pickle", "cos\nsystem\n(S'touch hacked'\ntR."),
        why="a pickle that runs a command",
    ),
    bad("cameras cam.pickle", "cam.pickle", change=text("cam.pickle", ""), why="an empty pickle"),
    bad(
        "cameras camera_array.toml",
        "camera_array.toml",
        change=text("camera_array.toml", "[cameras.0]\nsize = 3\n"),
        why="a size of one number",
    ),
    bad(
        "cameras trial --to caliscope --out x.toml",
        "cameras.toml",
        change=swap("trial/cameras.toml", "1.2, 0.3, -1.2", "nan, 0.3, -1.2"),
        why="NaN in a rotation",
    ),
    bad("cameras trial", "cameras.toml", change=folder_at("trial/cameras.toml"), why="a folder in its place"),
)

ENTRIES: tuple[BadInput, ...] = (*_BOARDS, *_SESSIONS, *_OTHERS)
"""The entries."""
