"""The check of the links of pages that all tests use."""

from pathlib import Path

import pytest

from marey.pipelines.progress import RecordingProgress
from marey.pipelines.run_record import finished_together, write_record
from tests.pages import broken_links

PAGE = """<a href="#run">Run</a> <a href="data.csv">table</a> <a href="a%20b/">folder</a> <img src="data:image/png,a">
<a href="https://example.org/a.html">elsewhere</a> <a href="gone_%3Ccamera%3E.png">image</a>"""


def written(out: Path, page: str) -> None:
    with finished_together(out) as folder:
        (folder / "report.html").write_text(page)
        (folder / "data.csv").write_text("1")
        (folder / "a b").mkdir()
        (folder / "a b" / "c.txt").write_text("1")
        write_record(folder, command="x", settings={}, inputs=[], root=out, progress=RecordingProgress())


def test_a_link_to_a_missing_file_is_an_error_of_every_test_that_writes_the_page(tmp_path):
    with pytest.raises(AssertionError, match="gone_<camera>"):
        written(tmp_path / "broken", PAGE)
    assert broken_links(tmp_path / "broken" / "report.html") == ["gone_<camera>.png"]
    written(tmp_path / "whole", PAGE.split(' <a href="gone')[0])
    assert broken_links(tmp_path / "whole" / "report.html") == []
