"""What a benchmark declares about itself, and how benchmarks are found."""

import ast
import importlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

GROUPS = ("capture", "surface", "markers", "nonrigid", "knee", "intervals", "study", "speed", "inputs")
"""Folders that hold benchmarks, in the order of `list` and of the pages."""

FOLDER = Path(__file__).parent


@dataclass(frozen=True, kw_only=True)
class Bench:
    """The declaration of a benchmark, assigned to `BENCH` in its module.

    All values are literals: a declaration is read without importing the module, so that `list` and `report` need
    neither marey nor its dependencies.

    Attributes:
        measures: One sentence: which quantity is compared with which reference.
        sources: Files and folders, relative to the project, whose code is measured. A change there makes a record old.
        minutes: Approximate duration on one core with the default arguments.
        data: Whether the folder of recordings (`--shared`) is needed.
        name: `group/module`; filled in from the module's place.
    """

    measures: str
    sources: Sequence[str]
    minutes: float
    data: bool = True
    name: str = field(default="")

    @property
    def group(self) -> str:
        """The folder of the benchmark, which is also the page of its results."""
        return self.name.partition("/")[0]

    @property
    def file(self) -> str:
        """The file of the benchmark, relative to the project."""
        return f"bench/{self.name}.py"

    def module(self) -> ModuleType:
        """Import the module that holds `arguments(parser)`, if any, and `run(run)`."""
        return importlib.import_module(f"bench.{self.name.replace('/', '.')}")


def find_benches(folder: Path = FOLDER) -> dict[str, Bench]:
    """Read the declarations of all benchmarks.

    Args:
        folder: The folder that holds the groups.

    Returns:
        Declarations by name, in the order of `GROUPS` and of the alphabet.
    """
    found = {}
    for group in GROUPS:
        for path in sorted((folder / group).glob("*.py")):
            name = f"{group}/{path.stem}"
            if declared := read_declaration(path, name):
                found[name] = declared
    return found


def read_declaration(path: Path, name: str) -> Bench | None:
    """Read `BENCH = Bench(...)` from a module's source, or return None where the module has none."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        match node:
            case ast.Assign(targets=[ast.Name(id="BENCH")], value=ast.Call(keywords=keywords)):
                return Bench(**{str(each.arg): ast.literal_eval(each.value) for each in keywords}, name=name)
    return None
