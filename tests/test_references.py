"""Every equation cites its source, and every source is in the bibliography."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
CITED = re.compile(r"\[([A-Za-z]+\d{4}[a-z]?)\]")
EQUATION = re.compile(r"\beqs?\. ?\(?\d")
PAGES = sorted([*(ROOT / "src").rglob("*.py"), *(ROOT / "bodies").rglob("*.py"), *(ROOT / "docs").rglob("*.md")])
TEXTS = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in PAGES}


def entries() -> list[str]:
    return re.findall(r"^@\w+\{([^,\s]+)", (ROOT / "docs" / "references.bib").read_text(encoding="utf-8"), re.MULTILINE)


def test_every_entry_of_the_bibliography_is_unique():
    assert sorted(set(entries())) == sorted(entries())


def test_every_citation_is_in_the_bibliography():
    known = set(entries())
    unknown = {name: missing for name, text in TEXTS.items() if (missing := set(CITED.findall(text)) - known)}
    assert unknown == {}


def test_every_equation_cites_its_source():
    assert [place for name, text in TEXTS.items() for place in without_source(name, text)] == []


def test_an_equation_without_a_source_is_seen():
    text = "As in [Hua2013] eq. (3).\n" + " " * 160 + "\nBy eq. (4)."
    assert without_source("page", text) == ["page, line 3: eq. (4"]


def without_source(name: str, text: str) -> list[str]:
    """Return the places of a text that name an equation, but not its source shortly before."""
    return [
        f"{name}, line {text.count(chr(10), 0, found.start()) + 1}: {found.group()}"
        for found in EQUATION.finditer(text)
        if not CITED.search(text[max(0, found.start() - 160) : found.start()])
    ]
