"""The site is built without a warning, shows the program's commands, and loads nothing from elsewhere."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from tests.computed_once import common_folder, wait_for

ROOT = Path(__file__).parents[2]


pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The site, built once for all parallel workers."""
    pytest.importorskip("mkdocs", reason="the site needs the packages of the extra `docs`")
    pytest.importorskip("latex2mathml", reason="the site needs the packages of the extra `docs`")
    folder = common_folder(tmp_path_factory) / "documentation"
    try:
        folder.mkdir()
    except FileExistsError:
        wait_for(folder, "built")
        return folder / "site"
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder / "site")]
    settings = os.environ | {"NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(ROOT / "src")}
    found = subprocess.run(command, cwd=ROOT, env=settings, capture_output=True, text=True, check=False)
    (folder / "built").touch()
    assert found.returncode == 0, found.stderr
    return folder / "site"


@pytest.mark.slow
def test_nothing_is_loaded_from_elsewhere(site: Path):
    loading = re.compile(r'<(?:script|img|iframe|source)[^>]*\bsrc="(?:https?:)?//|<link[^>]*\bhref="(?:https?:)?//')
    asking = [page.name for page in site.rglob("*.html") if loading.search(page.read_text(encoding="utf-8"))]
    assert asking == []
    sheets = [sheet.name for sheet in site.rglob("*.css") if "url(http" in sheet.read_text(encoding="utf-8")]
    assert sheets == []


def test_every_command_is_described(site: Path):
    page = (site / "reference" / "cli.html").read_text(encoding="utf-8")
    for command in ("capture", "surface", "shape", "markers", "nonrigid", "compare", "retarget", "knee segment"):
        assert f'id="marey-{command.replace(" ", "-")}"' in page


def test_formulas_are_shown_without_a_script(site: Path):
    page = (site / "explanation" / "capture.html").read_text(encoding="utf-8")
    assert "<math" in page
    assert "arithmatex" not in page


def test_citations_lead_to_the_bibliography(site: Path):
    page = (site / "explanation" / "capture.html").read_text(encoding="utf-8")
    assert '<a href="../reference/bibliography.html#rosenhahn2006">' in page
    assert 'id="rosenhahn2006"' in (site / "reference" / "bibliography.html").read_text(encoding="utf-8")


def test_everything_that_the_package_exports_is_documented(site: Path):
    import marey

    page = (site / "reference" / "api.html").read_text(encoding="utf-8")
    for name in getattr(marey, "__all__", ()):
        if not name.startswith("__"):
            assert re.search(rf'id="marey[\w.]*\.{name}"', page), name
