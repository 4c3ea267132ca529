"""What `import marey` offers: names, where they come from, and that importing them costs little."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import marey

PACKAGE = Path(marey.__file__)


@pytest.mark.parametrize("name", marey.__all__)
def test_every_public_name_is_there_and_documented(name: str):
    value = getattr(marey, name)
    if name != "__version__":
        assert value.__doc__
        assert value.__name__ == name


def test_the_names_for_type_checkers_are_those_that_are_imported():
    declared: dict[str, str] = {}
    for node in ast.walk(ast.parse(PACKAGE.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("marey."):
            declared |= {alias.name: (node.module or "").removeprefix("marey.") for alias in node.names}
    assert declared == marey._MODULES
    assert sorted([*marey._MODULES, "__version__"]) == sorted(marey.__all__)
    assert set(marey.__all__) <= set(dir(marey))


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'captur'"):
        marey.captur  # noqa: B018


def test_importing_the_package_loads_nothing_that_is_large():
    code = "import sys; before = set(sys.modules); import marey; print(*(set(sys.modules) - before))"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    large = {"numpy", "scipy", "numba", "cv2", "av", "rich", "typer"}
    assert not {name.split(".")[0] for name in shown.split()} & large
