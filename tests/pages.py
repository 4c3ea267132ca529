"""Links of report pages."""

from collections.abc import Iterator
from contextlib import contextmanager
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from marey.io.work_folder import WorkFolder
from marey.pipelines import run_record


class _Links(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [value for name, value in attrs if name in ("href", "src") and value]


def linked_files(page: Path) -> list[str]:
    """Return the files and folders beside a page to which it links; folders keep their slash."""
    parser = _Links()
    parser.feed(page.read_text(encoding="utf-8"))
    parts = [urlsplit(link) for link in parser.found]
    return [unquote(each.path) for each in parts if each.path and not each.scheme and not each.netloc]


def broken_links(page: Path) -> list[str]:
    """Return the links of a page to files and folders that do not exist."""
    return [link for link in linked_files(page) if not (page.parent / link).exists()]


@contextmanager
def links_checked() -> Iterator[None]:
    """While this lasts, results with a page that has broken links are an error when they appear in their folder."""
    move_in = run_record._move_in

    def checked(staging: Path, work: WorkFolder) -> None:
        pages = [path.relative_to(staging) for path in staging.rglob("*.html")]
        move_in(staging, work)
        broken = {str(page): links for page in pages if (links := broken_links(work.out / page))}
        assert not broken, f"links to files that do not exist: {broken}"

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_record, "_move_in", checked)
        yield
