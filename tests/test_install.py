"""What an installed program needs besides its code."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import marey

ROOT = Path(__file__).parents[1]


def test_the_import_of_the_package_has_no_side_effects(tmp_path):
    code = (
        "import os, sys; before = dict(os.environ), set(sys.modules); import marey;"
        "print(dict(os.environ) == before[0], *(set(sys.modules) - before[1]))"
    )
    environment = {**os.environ, "HOME": str(tmp_path / "none"), "TMPDIR": str(tmp_path)}
    shown = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert shown.stdout.split() == ["True", "marey"]
    assert list(tmp_path.iterdir()) == []


def test_the_program_answers_without_loading_what_it_does_not_need():
    code = "import sys; from marey.cli.main import run; run(['--version']); print(*sys.modules)"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert shown.startswith(f"marey {marey.__version__}")
    loaded = set(shown.split())
    assert not loaded & {"numba", "scipy", "cv2", "av"}


@pytest.mark.parametrize("page", [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))], ids=lambda p: p.name)
def test_pages_link_only_to_what_is_there(page: Path):
    text = page.read_text(encoding="utf-8")
    links = [link.split("#")[0] for link in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in link]
    missing = [link for link in links if link and not (page.parent / link).exists()]
    # The figures are written when a release is measured.
    assert missing == []


def test_data_that_the_program_reads_is_declared_as_part_of_the_package():
    declared = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    package = ROOT / "src" / "marey"
    kinds = {p.suffix for p in package.rglob("*") if p.is_file() and p.suffix not in (".py", ".pyc", ".nbi", ".nbc")}
    assert kinds <= {".npz", ".toml", ".html", ".js", ".css", ".typed", ""}
    for kind in kinds - {".typed", ""}:
        assert f"**/*{kind}" in declared
