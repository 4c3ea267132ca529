"""The verdict of a run, which its last lines on the terminal, the head of its page and run.json share."""

import html
import json
from pathlib import Path

from marey.pipelines.verdict import Verdict


def agreed_verdict(record: Path, *, printed: str | None = None, page: Path | None = None) -> Verdict:
    """Return the verdict in a record, after a check that terminal and page state the same.

    Args:
        record: The record, or another JSON file with a verdict.
        printed: What the command has printed.
        page: The page.
    """
    verdict = Verdict.from_record(json.loads(record.read_text(encoding="utf-8")))
    assert verdict is not None
    if printed is not None:
        assert str(verdict) in printed
        # Behind the verdict there are only the places of the results.
        after = printed[printed.index(str(verdict)) + len(str(verdict)) :].strip().splitlines()
        assert after
        assert all(": " in line and not line.startswith("-") for line in after)
    if page is not None:
        text = html.unescape(page.read_text(encoding="utf-8"))
        level, reasons = verdict.texts()
        head = text[text.index('<section id="verdict"') :]
        shown = head[: head.index("</section>")]
        assert f"Verdict: {level}" in shown
        listed = [line.strip() for line in shown.splitlines() if "<li>" in line]
        assert listed == [f"<li>{each}</li>" for each in reasons]
    return verdict
