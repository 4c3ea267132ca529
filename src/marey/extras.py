"""Optional packages: imported when they are needed, with an error that names the command which installs them."""

import importlib
import re
import sys
from importlib.metadata import PackageNotFoundError, requires
from types import ModuleType

from marey.errors import MissingPackage


def import_optional(module: str, *, extra: str, purpose: str) -> ModuleType:
    """Import a module of a package that belongs to one of the optional dependencies.

    Args:
        module: Name of the module, for example `skimage.measure`.
        extra: The group of optional dependencies in `pyproject.toml` that contains its package.
        purpose: What needs the package, as the subject of a sentence in the plural ("Surfaces of bones").

    Raises:
        MissingPackage: The package is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise missing_package(module, extra=extra, purpose=purpose) from error


def missing_package(module: str, *, extra: str, purpose: str) -> MissingPackage:
    """Return the error for a missing optional package, with the command that installs the packages of its group."""
    return MissingPackage(f"{purpose} need {module.split('.')[0]}, which is not installed. {install_advice(extra)}")


def install_advice(extra: str) -> str:
    """Return a sentence with the command that installs a group of optional dependencies.

    The command names the packages themselves. `marey` is never named: a package of that name on the public index is not
    this one.
    """
    packages = packages_of(extra)
    if not packages:
        return f'In a clone of the project, run: python -m pip install ".[{extra}]"'
    quoted = " ".join(f'"{package}"' for package in packages)
    return f"Run: {'py' if sys.platform == 'win32' else 'python'} -m pip install {quoted}"


def packages_of(extra: str) -> list[str]:
    """Return the requirements of a group of optional dependencies as the installed package declares them."""
    try:
        declared = requires("marey") or []
    except PackageNotFoundError:
        return []
    marked = re.compile(rf"""extra\s*==\s*["']{re.escape(extra)}["']""")
    return [requirement.split(";")[0].strip() for requirement in declared if marked.search(requirement)]
