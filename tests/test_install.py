"""What an installed program needs besides its code."""

import importlib.metadata
import os
import re
import subprocess
import sys
from pathlib import Path

import marey

ROOT = Path(__file__).parents[1]


def test_kernels_are_kept_in_a_private_folder_where_nothing_else_can_be_written_to(monkeypatch):
    monkeypatch.setattr(os, "access", lambda place, mode: False)
    monkeypatch.setenv("NUMBA_CACHE_DIR", "given")
    marey._find_place_for_kernels()
    assert os.environ["NUMBA_CACHE_DIR"] == "given"
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    marey._find_place_for_kernels()
    place = Path(os.environ["NUMBA_CACHE_DIR"])
    assert place.is_dir()
    assert place.stat().st_mode & 0o077 == 0
    place.rmdir()


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
    monkeypatch.delitem(vars(marey), "__version__")


def test_the_program_answers_without_loading_what_it_does_not_need():
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
