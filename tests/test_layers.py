"""The rooms stand in the order of the data: a module imports only from rooms above its own in this list."""

import ast
from collections import Counter
from functools import cache
from pathlib import Path

SOURCE = Path(__file__).parents[1] / "src" / "marey"
ROOMS: dict[str, tuple[str, ...]] = {
    "compiled": (),
    "geometry": (),
    "cameras": (),
    "images": ("silhouettes", "features", "matching"),
    "body": ("articulation", "people", "metaballs"),
    "surface": ("points", "tracks"),
    "observations": (),
    "fit": ("solver", "clocks", "consistency", "search", "recipes", "cameras", "patches", "regions", "points"),
    "motion": ("events", "groups"),
    "calibration": ("boards", "adjustment", "timing", "sights", "quality"),
    "nonrigid": ("core", "in_space", "one_camera", "many_cameras", "tracking", "correspondence"),
    "markers": ("data", "preprocessing", "methods", "kinematics"),
    "knee": ("space", "bones", "registration", "cartilage", "outlines", "markers", "motion"),
    "io": (
        *("video", "calibration", "trial", "opensim", "markers", "devices", "gltf", "shapes", "mr", "results"),
        "study",
    ),
    "view": ("pictures", "pages", "svg", "gait", "outline", "viewer", "study"),
    "pipelines": (
        *("causes", "people", "clocks", "consistency", "cameras", "calibrate", "occlusion", "silhouettes", "gait"),
        *("capture", "from_person", "sync", "group", "surface", "shape", "marker_sets", "markers", "nonrigid", "knee"),
        *("exchange", "viewer", "speed", "study"),
    ),
    "cli": (),
}
"""Rooms and their sub-rooms, each in the order in which they may import: from earlier ones, never from later ones."""
ABOVE = {"nonrigid.recovered", "pipelines.compare", "pipelines.device", "pipelines.retarget"}
"""Modules directly in a room that stand after its sub-rooms; all others stand before them."""
MOST_FILES = 15
MODULES = {
    ".".join(path.relative_to(SOURCE).with_suffix("").parts): path for path in sorted(SOURCE.rglob("*.py"))
}  # fmt: skip


def imported_modules(path: Path) -> set[str]:
    """Return the modules of the package that a module imports, also inside functions and for types only."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.removeprefix("marey.") for alias in node.names if alias.name.startswith("marey.")}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "marey":
            base = (node.module or "").removeprefix("marey").removeprefix(".")
            names = {f"{base}.{alias.name}".removeprefix(".") for alias in node.names}
            found |= {name if name in MODULES else base for name in names}
    return {name for name in found if name}


@cache
def imports() -> dict[str, set[str]]:
    return {name: imported_modules(path) for name, path in MODULES.items()}


def place(module: str) -> tuple[int, int] | None:
    """Return the positions of a module's room and sub-room; None for a module outside of all rooms."""
    room, *rest = module.split(".")
    if room not in ROOMS:
        return None
    order = ROOMS[room]
    if rest and rest[0] in order:
        return list(ROOMS).index(room), order.index(rest[0])
    return list(ROOMS).index(room), len(order) if module in ABOVE else -1


def upward(module: str) -> list[str]:
    """Return the modules that a module imports from below its own room."""
    own = place(module)
    return [other for other in sorted(imports()[module]) if (at := place(other)) and own and at > own]


def test_a_module_imports_only_from_rooms_above_its_own():
    assert len(MODULES) > 700
    assert {module: found for module in MODULES if (found := upward(module))} == {}


def test_an_import_from_a_later_room_is_seen(monkeypatch):
    monkeypatch.setitem(imports(), "geometry.rotations", {"cameras.camera", "arrays", "geometry.rigid"})
    assert upward("geometry.rotations") == ["cameras.camera"]


def test_no_module_imports_itself_through_others():
    """Imports for types count as well: a cycle of types is a cycle of ideas."""
    assert find_cycle(imports()) == []


def test_a_cycle_is_found():
    assert find_cycle({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": set()}) == ["b", "c", "b"]


def find_cycle(graph: dict[str, set[str]]) -> list[str]:
    """Return the modules of one cycle of imports, or an empty list."""
    done: set[str] = set()

    def walk(module: str, trail: list[str]) -> list[str]:
        if module in trail:
            return [*trail[trail.index(module) :], module]
        if module not in done:
            for other in sorted(graph.get(module, set()) & set(graph)):
                if cycle := walk(other, [*trail, module]):
                    return cycle
            done.add(module)
        return []

    return next((cycle for start in graph if (cycle := walk(start, []))), [])


def test_every_folder_is_a_room_or_sub_room_in_the_list():
    folders = {path.parent.relative_to(SOURCE).parts for path in SOURCE.rglob("__init__.py")} - {()}
    listed = {(room,) for room in ROOMS} | {(room, inner) for room, order in ROOMS.items() for inner in order}
    assert folders == listed


def test_a_room_holds_about_fifteen_files_at_most():
    files = Counter(path.parent.relative_to(SOURCE) for path in MODULES.values() if path.name != "__init__.py")
    assert {str(folder): count for folder, count in files.items() if count > MOST_FILES} == {}
