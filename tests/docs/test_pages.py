"""The documentation: its pages, links and anchors, the modules it names, and the commands it lists."""

import importlib
import importlib.util
import re
import unicodedata
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")] + sorted(DOCS.rglob("*.md"))
CODE = re.compile(r"^( *)```.*?^\1```[^\n]*$|^(?: {4}|\t)[^\n]*$", re.MULTILINE | re.DOTALL)
ROOMS = [path.name for path in (ROOT / "src" / "marey").iterdir() if path.is_dir()]
MADE = {"reference/cli.md", "reference/api.md", "reference/bibliography.md"}
"""Pages of which the build makes the content."""


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def anchors(page: Path) -> set[str]:
    """The anchors that MkDocs gives to the headings of a page."""
    found: set[str] = set()
    for heading in re.findall(r"^#+ +(.+?) *$", CODE.sub("", text_of(page)), re.MULTILINE):
        given = re.search(r"\{ *#([\w-]+) *\}", heading)
        plain = re.sub(r"\{[^}]*\}|\[([^\]]*)\]\([^)]*\)|[`*]", r"\1", heading)
        plain = unicodedata.normalize("NFKD", plain).encode("ascii", "ignore").decode()
        slug = re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", plain).strip().lower())
        found.add(given.group(1) if given else slug)
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_to_pages_and_headings_that_exist(page: Path):
    missing = []
    for link in re.findall(r"\]\(([^)\s]+)\)", CODE.sub("", text_of(page))):
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        made = target.is_relative_to(DOCS) and target.relative_to(DOCS).as_posix() in MADE
        if not target.exists() or (anchor and not made and anchor not in anchors(target)):
            missing.append(link)
    assert missing == []


def test_every_page_is_in_the_navigation():
    listed = set(re.findall(r"([\w/-]+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE))
    there = {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")}
    # Those that belong to the page on accuracy are added when the site is built.
    assert listed == {page for page in there if not page.startswith("accuracy/")}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_modules_that_pages_name_exist(page: Path):
    text = text_of(page)
    unknown = [name for name in re.findall(r"(?<![\w/@-])marey(?:\.[a-z_]\w*)+", text) if not leads_somewhere(name)]
    files = re.findall(rf"`((?:{'|'.join(ROOMS)})/[\w/]+\.py)`", text)
    unknown += [name for name in files if not (ROOT / "src" / "marey" / name).exists()]
    assert unknown == []


def leads_somewhere(name: str) -> bool:
    """Whether a dotted name is a module, or something in one."""
    package, _, last = name.rpartition(".")
    if name.endswith((".toml", ".md")) or last in ("npz", "py"):
        return True
    try:
        if importlib.util.find_spec(name) is not None:
            return True
    except ModuleNotFoundError:
        pass
    try:
        return hasattr(importlib.import_module(package), last)
    except ModuleNotFoundError:
        return False


def test_pages_never_install_the_name_from_an_index():
    for page in PAGES:
        for line in text_of(page).splitlines():
            if re.search(r"pip install[^`]*[\s\"']marey\b", line):
                assert "Never" in line, f"{page.name}: {line}"


def test_pages_named_in_the_code_exist():
    named = set()
    for path in [*(ROOT / "src").rglob("*.py"), *(ROOT / "bodies").rglob("*.py")]:
        named |= set(re.findall(r"docs/[\w/.-]+\.(?:md|bib|png|jpg)", path.read_text(encoding="utf-8")))
    assert {name for name in named if not (ROOT / name).exists()} == set()
