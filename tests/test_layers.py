"""The rooms stand in the order of the data: a module imports only from rooms above its own."""

import ast
from pathlib import Path

import pytest

ROOMS = (
    *["geometry", "cameras", "images", "body", "surface", "observations", "fit", "motion"],
    *["nonrigid", "markers", "knee", "io", "view", "cli"],
)
SOURCE = Path(__file__).parents[1] / "src" / "marey"
MODULES = sorted(path for room in ROOMS for path in (SOURCE / room).rglob("*.py"))


def imported_rooms(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
        elif isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
    return {name.split(".")[1] for name in names if name.startswith("marey.")} & set(ROOMS)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(SOURCE)))
def test_a_module_imports_only_from_rooms_above_its_own(path: Path):
    own = ROOMS.index(path.relative_to(SOURCE).parts[0])
    assert all(ROOMS.index(room) <= own for room in imported_rooms(path))
