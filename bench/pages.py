"""The pages under docs/accuracy, written from the records."""

from collections.abc import Callable, Iterable
from pathlib import Path

from bench.declaration import FOLDER, GROUPS, Bench, find_benches
from bench.headline import with_headlines
from bench.provenance import PROJECT, Age, age
from bench.recording import RECORDS, Record, Table, read_records

TITLES = {
    "capture": "Accuracy of capture",
    "surface": "Accuracy of surfaces, trajectories and shape",
    "markers": "Accuracy of bones from skin markers",
    "nonrigid": "Accuracy of non-rigid factorisation",
    "knee": "Accuracy of knees from magnetic resonance images",
    "intervals": "Stated intervals and true errors",
    "study": "Studies of many trials",
    "speed": "Speed and memory",
    "inputs": "Damaged and mistyped inputs",
}
HEAD = """<!-- Written by `python -m bench report` from bench/records; do not edit by hand. -->
# {title}

Every table below comes from a record that `python -m bench run NAME` has written. A table whose code has changed since
it was measured is marked **OLD**; one whose figures were taken over from an earlier page is marked **NOT
RE-MEASURED**. [Accuracy](../accuracy.md) states what the figures are worth.
"""
AgeOf = Callable[[Bench, Record], Age]


def write_pages(
    pages: Path = PROJECT / "docs" / "accuracy",
    benches: Path = FOLDER,
    records: Path = RECORDS,
    project: Path = PROJECT,
) -> list[Path]:
    """Write one page per group of benchmarks, and the headline figures into the page beside their folder.

    Args:
        pages: The folder of the pages.
        benches: The folder of the benchmarks.
        records: The folder of the records.
        project: The repository whose history gives the age of a record.

    Returns:
        The pages.
    """
    declared, kept = find_benches(benches), read_records(records)
    pages.mkdir(parents=True, exist_ok=True)
    written = []
    for group in GROUPS:
        own = [bench for bench in declared.values() if bench.group == group]
        path = pages / f"{group}.md"
        path.write_text(page(group, own, kept, project), encoding="utf-8")
        written.append(path)
    overview = pages.with_suffix(".md")
    if overview.exists():
        by_file = {path: record for each in kept.values() for path, record in each}
        text = with_headlines(overview.read_text(encoding="utf-8"), by_file, declared, records, project)
        overview.write_text(text, encoding="utf-8")
        written.append(overview)
    return written


def page(
    group: str, benches: Iterable[Bench], records: dict[str, list[tuple[Path, Record]]], project: Path = PROJECT
) -> str:
    """The text of one page: measured benchmarks, then the names of those without a record."""
    parts, missing = [HEAD.format(title=TITLES[group])], []
    for bench in benches:
        kept = records.get(bench.name, [])
        if kept:
            parts.append(f"## {bench.name}\n\n{bench.measures}\n")
            parts += [section(bench, record, project) for record in sorted((each for _, each in kept), key=_command)]
        else:
            missing.append(f"- `{bench.name}` (about {bench.minutes:g} min): {bench.measures}")
    if missing:
        parts.append("## Not measured yet\n\nThese benchmarks have no record.\n\n" + "\n".join(missing) + "\n")
    return "\n".join(parts)


def _command(record: Record) -> str:
    return record.command


def section(bench: Bench, record: Record, project: Path = PROJECT) -> str:
    """One record: its command, its tables, and where the figures come from."""
    tables = "\n".join(table_text(table) for table in record.tables)
    return f"    {record.command}\n\n{tables}\n{provenance(bench, record, project)}\n"


def provenance(bench: Bench, record: Record, project: Path = PROJECT) -> str:
    """The line below a record's tables: commit, date, machine, and the mark of an old record."""
    if record.source:
        return f"**NOT RE-MEASURED**: {record.source.removesuffix(', not re-measured')}.\n"
    machine = record.machine
    line = (
        f"*Commit {record.commit[:7]}, {record.date}, {(record.seconds or 0) / 60:.1f} min on "
        f"{machine.get('processor')} ({machine.get('cores')} cores), Python {machine.get('python')}, "
        f"NumPy {machine.get('numpy')}, Numba {machine.get('numba')}.*"
    )
    marks = [mark(age(record.commit, [*bench.sources, bench.file], project))]
    if record.dirty:
        marks.append("**UNCOMMITTED CHANGES** were part of the measured code.")
    return " ".join([line, *filter(None, [record.note, *marks])]) + "\n"


def mark(how: Age) -> str:
    """The mark of an old record, or nothing."""
    if not how.known:
        return "**OLD**: the measured commit is not part of this history."
    if not how.old:
        return ""
    files = ", ".join(f"`{name}`" for name in how.files[:3])
    more = f" and {len(how.files) - 3} more files" if len(how.files) > 3 else ""
    return f"**OLD**: the measured code has changed since, last in commit {how.commits[0]} ({files}{more})."


def table_text(table: Table) -> str:
    """A table in Markdown, with its title above and its note below."""
    headings = [*table.labels, *(column.heading for column in table.columns)]
    rows = [table.cells(row) for row in table.rows]
    lines = [" | ".join(map(_cell, row)) for row in (headings, ["---"] * len(headings), *rows)]
    text = f"**{table.title}**\n\n" + "\n".join(f"| {line} |" for line in lines) + "\n"
    return f"{text}\n{table.note}\n" if table.note else text


def _cell(text: str) -> str:
    """Return a text that is no markup in a cell of a table, on one line and without control characters."""
    line = text.replace("|", "\\|").replace("<", "&lt;").replace("\n", " ")
    return "".join(sign if sign.isprintable() else ascii(sign)[1:-1] for sign in line)
