"""What an installed program needs besides its code."""

import importlib.metadata
import os
import re
import subprocess
import sys
from pathlib import Path

import marey

ROOT = Path(__file__).parents[1]


def test_the_import_of_the_package_has_no_side_effects(tmp_path):
    code = (
        "import os, sys; before = dict(os.environ), set(sys.modules); import marey;"
        "new = set(sys.modules) - before[1];"
        "added = [name for name in new if name.split('.')[0] not in sys.stdlib_module_names];"
        "print(dict(os.environ) == before[0], *added)"
    )
    environment = {**os.environ, "HOME": str(tmp_path / "none"), "TMPDIR": str(tmp_path)}
    shown = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert shown.stdout.split() == ["True", "marey"]
    assert list(tmp_path.iterdir()) == []


def test_the_version_is_read_when_it_is_needed_and_not_at_import():
    code = "import sys, marey; print('importlib.metadata' in sys.modules, marey.__version__)"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert shown[0] == "False"
    assert re.match(r"\d", shown[1])


def test_the_version_of_a_tree_that_was_not_installed_is_unknown(monkeypatch):
    def missing(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.delitem(vars(marey), "__version__", raising=False)
    monkeypatch.setattr(importlib.metadata, "version", missing)
    assert marey.__version__ == marey.UNKNOWN_VERSION
    # What was just read is not to stay for other tests.
    del marey.__version__


def test_the_program_starts_without_loading_what_it_does_not_need():
    code = "import sys; from marey.cli.main import run; run(['--version']); print(*sys.modules)"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert shown.startswith(f"marey {marey.__version__}")
    loaded = set(shown.split())
    assert not loaded & {"numba", "scipy", "cv2", "av"}


def test_data_that_the_program_reads_is_declared_as_part_of_the_package():
    declared = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    package = ROOT / "src" / "marey"
    kinds = {p.suffix for p in package.rglob("*") if p.is_file() and p.suffix not in (".py", ".pyc", ".nbi", ".nbc")}
    assert kinds <= {".npz", ".toml", ".html", ".js", ".css", ".typed", ""}
    for kind in kinds - {".typed", ""}:
        assert f"**/*{kind}" in declared
