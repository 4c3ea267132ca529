"""Every equation cites its source, and every source is in the bibliography."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CITED = re.compile(r"\[([A-Za-z]+\d{4}[a-z]?)\]")
EQUATION = re.compile(r"\beqs?\. ?\(?\d")
PAGES = sorted([*(ROOT / "src").rglob("*.py"), *(ROOT / "bodies").rglob("*.py"), *(ROOT / "docs").rglob("*.md")])


def entries() -> list[str]:
    return re.findall(r"^@\w+\{([^,\s]+)", (ROOT / "docs" / "references.bib").read_text(encoding="utf-8"), re.MULTILINE)


def test_every_entry_of_the_bibliography_is_unique():
    assert sorted(set(entries())) == sorted(entries())


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_citation_is_in_the_bibliography(path: Path):
    unknown = set(CITED.findall(path.read_text(encoding="utf-8"))) - set(entries())
    assert not unknown


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_equation_cites_its_source(path: Path):
    text = path.read_text(encoding="utf-8")
    for found in EQUATION.finditer(text):
        before = text[max(0, found.start() - 160) : found.start()]
        assert CITED.search(before), f"line {text.count(chr(10), 0, found.start()) + 1}: {found.group()}"
