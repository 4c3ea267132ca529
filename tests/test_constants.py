"""Every module constant carries a docstring with its meaning, its unit, and where its value comes from."""

import ast
import re
from functools import cache
from pathlib import Path

SOURCE = Path(__file__).parents[1] / "src" / "marey"
MODULES = sorted(SOURCE.rglob("*.py"))
CONSTANT = re.compile(r"^_?[A-Z][A-Z0-9_]*$")
FEWEST_WORDS = 4


@cache
def trees() -> dict[str, ast.Module]:
    return {str(path.relative_to(SOURCE)): ast.parse(path.read_text(encoding="utf-8")) for path in MODULES}


def constants(tree: ast.Module) -> list[tuple[str, int, str | None]]:
    """Return name, line and docstring of every module constant; several names of one statement share a docstring."""
    found = []
    for statement, following in zip(tree.body, [*tree.body[1:], None], strict=True):
        if isinstance(statement, ast.Assign):
            targets = [node for target in statement.targets for node in ast.walk(target) if isinstance(node, ast.Name)]
        elif isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            targets = [statement.target]
        else:
            continue
        names = [node.id for node in targets if CONSTANT.match(node.id)]
        text = None
        if isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
            text = following.value.value if isinstance(following.value.value, str) else None
        found += [(name, statement.lineno, text) for name in names]
    return found


def test_every_constant_has_a_docstring():
    without = [
        f"{path}, line {line}: {name}"
        for path, tree in trees().items()
        for name, line, text in constants(tree)
        if text is None or len(text.split()) < FEWEST_WORDS
    ]
    assert without == []


def test_the_check_sees_a_constant_without_docstring():
    tree = ast.parse("FIRST = 1.0\n\nSECOND = 2.0\n'''Distance in metres, chosen by hand.'''\n\nlower = 3\n")
    assert constants(tree) == [("FIRST", 1, None), ("SECOND", 3, "Distance in metres, chosen by hand.")]


def settings_values(tree: ast.Module) -> list[tuple[str, float]]:
    """Return the numeric constants of a module by name."""
    values = []
    for statement in tree.body:
        if isinstance(statement, ast.Assign) and isinstance(statement.value, ast.Constant):
            number = statement.value.value
            for target in statement.targets:
                if isinstance(target, ast.Name) and CONSTANT.match(target.id) and isinstance(number, int | float):
                    values.append((target.id, float(number)))
    return values


def test_one_public_name_has_one_value():
    """Two constants of the same public name with different values are two quantities and need two names."""
    seen: dict[str, dict[float, str]] = {}
    for path, tree in trees().items():
        for name, number in settings_values(tree):
            if not name.startswith("_"):
                seen.setdefault(name, {}).setdefault(number, path)
    assert {name: where for name, where in seen.items() if len(where) > 1} == {}
