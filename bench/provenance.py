"""Where figures come from: commit, machine, and whether the measured code has changed since."""

import ast
import os
import platform
import subprocess
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from itertools import islice
from pathlib import Path

PROJECT = Path(__file__).parents[1]
PACKAGES = ("numpy", "numba", "scipy", "opencv-python-headless")
"""Packages whose versions can change a figure."""


def git(*arguments: str, project: Path = PROJECT) -> str:
    """Run a git command in the project; its output without the last line break."""
    command = ["git", *arguments]
    return subprocess.run(command, cwd=project, check=True, capture_output=True, text=True).stdout.rstrip("\n")


def machine() -> dict[str, str]:
    """The processor and the versions, without the machine's name."""
    versions = {name: _version(name) for name in PACKAGES}
    return {
        "processor": _processor(),
        "cores": str(os.cpu_count()),
        "system": platform.system(),
        "python": platform.python_version(),
    } | versions


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _processor() -> str:
    information = Path("/proc/cpuinfo")
    if information.is_file():
        for line in information.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def current_commit(project: Path = PROJECT) -> str:
    """The commit that is checked out."""
    return git("rev-parse", "HEAD", project=project)


def is_dirty(sources: Iterable[str], project: Path = PROJECT) -> bool:
    """Whether any of the files has changes that are not committed."""
    return bool(git("status", "--porcelain", "--", *sources, project=project))


@dataclass(frozen=True)
class Age:
    """How a record relates to the present code.

    Attributes:
        known: Whether the record's commit is part of the history.
        commits: The commits since the record that touched the measured files, newest first (short hashes).
        files: The files among them whose code, not only their wording, differs from the record's.
    """

    known: bool
    commits: tuple[str, ...] = ()
    files: tuple[str, ...] = ()

    @property
    def old(self) -> bool:
        """Whether the figures may differ from what the present code gives."""
        return not self.known or bool(self.files)


def age(commit: str, sources: Sequence[str], project: Path = PROJECT, *, most: int | None = None) -> Age:
    """Find what has changed in the measured files since a commit.

    Comments and docstrings do not count as a change of code: of Python files the syntax trees are compared.

    Args:
        commit: The commit of a record.
        sources: Files and folders, relative to the project.
        project: The folder of the repository.
        most: Number of changed files after which no others are looked for; all are listed by default. Comparing files
            takes most of the time.
    """
    try:
        git("merge-base", "--is-ancestor", commit, "HEAD", project=project)
    except subprocess.CalledProcessError:
        return Age(known=False)
    commits = git("log", "--format=%h", f"{commit}..HEAD", "--", *sources, project=project).split()
    if not commits:
        return Age(known=True)
    head = current_commit(project)
    names = git("diff", "--no-renames", "--name-only", commit, head, "--", *sources, project=project).splitlines()
    changed = (name for name in names if _code(commit, name, project) != _code(head, name, project))
    return Age(known=True, commits=tuple(commits), files=tuple(islice(changed, most)))


@cache
def _code(commit: str, name: str, project: Path) -> str | None:
    """The syntax tree of a Python file without docstrings, the text of another file, or None where there is none."""
    try:
        text = git("show", f"{commit}:{name}", project=project)
    except subprocess.CalledProcessError:
        return None
    except UnicodeDecodeError:
        return git("rev-parse", f"{commit}:{name}", project=project)
    if not name.endswith(".py"):
        return text
    tree = ast.parse(text)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            body[:] = [each for each in body if not _is_text(each)]
    return ast.dump(tree)


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
