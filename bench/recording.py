"""The tables that a benchmark fills while it runs, and the JSON records that keep them."""

import argparse
import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

Value = float | int | str | None
"""A number, a text such as "3.0 / 1.7", or None where there is no result."""

RECORDS = Path(__file__).parent / "records"


@dataclass(frozen=True)
class Column:
    """One quantity of a table.

    Attributes:
        name: What is measured.
        unit: Its unit; empty for shares, counts and texts.
        digits: Printed digits after the decimal point; None prints the value unchanged, a whole number
            without a decimal point.
    """

    name: str
    unit: str = ""
    digits: int | None = None

    @property
    def heading(self) -> str:
        """The column's heading with its unit."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def text(self, value: Value) -> str:
        """Print a value with the column's digits; a dash stands for a missing value."""
        if value is None or value != value:
            return "-"
        if isinstance(value, float) and self.digits is None and value.is_integer():
            return str(int(value))
        if isinstance(value, str) or self.digits is None:
            return str(value)
        return f"{value:.{self.digits}f}"


@dataclass
class Table:
    """A table that grows row by row and prints each row as soon as it is known."""

    title: str
    labels: tuple[str, ...]
    columns: tuple[Column, ...]
    rows: list[tuple[tuple[str, ...], tuple[Value, ...]]] = field(default_factory=list)
    note: str = ""
    printing: bool = False

    def __post_init__(self) -> None:
        """Print the heading."""
        self._print(f"\n{self.title}\n" + " | ".join([*self.labels, *(column.heading for column in self.columns)]))

    def row(self, labels: str | Sequence[str], *values: Value) -> None:
        """Append a row.

        Args:
            labels: One label, or one for each of the table's label columns.
            values: One value per column. NumPy scalars become Python numbers.

        Raises:
            ValueError: If there are more or fewer labels or values than columns.
        """
        named = (labels,) if isinstance(labels, str) else tuple(map(str, labels))
        plain = tuple(_plain(value) for value in values)
        if (len(named), len(plain)) != (len(self.labels), len(self.columns)):
            raise ValueError(
                f"{self.title}: a row has {len(self.labels)} labels and {len(self.columns)} values, "
                f"not {len(named)} and {len(plain)}."
            )
        self.rows.append((named, plain))
        self._print(" | ".join(self.cells(self.rows[-1])))

    def cells(self, row: tuple[tuple[str, ...], tuple[Value, ...]]) -> list[str]:
        """The texts of a row: labels, then values with their digits."""
        return [*row[0], *(column.text(value) for column, value in zip(self.columns, row[1], strict=True))]

    def _print(self, text: str) -> None:
        if self.printing:
            print(text, flush=True)


def _plain(value: object) -> Value:
    item = getattr(value, "item", None)
    plain = item() if callable(item) else value
    if plain is None or isinstance(plain, (int, float, str)):
        return plain
    raise ValueError(f"A value of a table is a number, a text or None, not {type(value).__name__}.")


@dataclass
class Run:
    """What a benchmark receives: its arguments, the folders, and where its figures go.

    Attributes:
        arguments: The parsed arguments of the benchmark.
        shared: The folder of recordings: `data` and `score`.
        out: A folder for results. It belongs to one commit, so that results of other code are never used again.
        printing: Whether rows are printed as they come.
        tables: The tables so far.
    """

    arguments: argparse.Namespace
    shared: Path
    out: Path
    printing: bool = True
    tables: list[Table] = field(default_factory=list)

    def table(self, title: str, labels: str | Sequence[str], *columns: Column, note: str = "") -> Table:
        """Begin a table.

        Args:
            title: What the table shows.
            labels: The heading of the column of labels, or of several such columns.
            columns: The measured quantities.
            note: Text below the table: definitions, sample sizes.

        Returns:
            The empty table, which is already part of the record.
        """
        headings = (labels,) if isinstance(labels, str) else tuple(labels)
        self.tables.append(Table(title, headings, columns, note=note, printing=self.printing))
        return self.tables[-1]

    def report(self, text: str) -> None:
        """Print a line that is not recorded."""
        if self.printing:
            print(text, flush=True)


@dataclass(frozen=True, kw_only=True)
class Record:
    """The figures of one run, with what is needed to judge and to repeat them.

    Attributes:
        bench: Name of the benchmark.
        command: The command that repeats the run.
        commit: The commit that was measured; empty for figures that were carried over.
        dirty: Whether the measured files had changes that were not committed.
        date: Day of the run.
        machine: Processor, cores and versions.
        seconds: Duration of the run; None for figures that were carried over.
        note: Circumstances of the run, such as other work on the machine.
        source: Empty for a run; otherwise where the figures come from.
        tables: The figures.
    """

    bench: str
    command: str
    commit: str
    dirty: bool
    date: str
    machine: dict[str, str]
    seconds: float | None
    note: str = ""
    source: str = ""
    tables: tuple[Table, ...] = ()


def record_path(bench: str, arguments: Iterable[str], records: Path = RECORDS) -> Path:
    """The file of a record: the benchmark's name and its arguments."""
    parts = [re.sub(r"[^A-Za-z0-9.+]+", "-", word).strip("-") for word in arguments]
    return records / (".".join([bench, *filter(None, parts)]) + ".json")


def write_record(record: Record, path: Path) -> None:
    """Write a record as JSON; one row of figures per line, so that differences can be read."""
    tables = [
        {
            "title": table.title,
            "note": table.note,
            "labels": table.labels,
            "columns": [asdict(column) for column in table.columns],
            "rows": [{"labels": labels, "values": [_short(v) for v in values]} for labels, values in table.rows],
        }
        for table in record.tables
    ]
    content = {name: getattr(record, name) for name in Record.__dataclass_fields__} | {"tables": tables}
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(_rows_on_lines(text) + "\n", encoding="utf-8")


def _short(value: Value) -> Value:
    """Eight digits are more than any table prints; what is not finite is no figure."""
    if isinstance(value, float):
        return float(f"{value:.8g}") if abs(value) < float("inf") else None
    return value


def _rows_on_lines(text: str) -> str:
    """Join the lines of the innermost objects: columns and rows."""
    return re.sub(r"\{[^{}]*\}", lambda each: re.sub(r"\s*\n\s*", " ", each.group()), text)


def read_record(path: Path) -> Record:
    """Read a record."""
    content = json.loads(path.read_text(encoding="utf-8"))
    tables = tuple(
        Table(
            table["title"],
            tuple(table["labels"]),
            tuple(Column(**column) for column in table["columns"]),
            [(tuple(row["labels"]), tuple(row["values"])) for row in table["rows"]],
            table["note"],
        )
        for table in content["tables"]
    )
    return Record(**content | {"tables": tables})


def read_records(records: Path = RECORDS) -> dict[str, list[tuple[Path, Record]]]:
    """Read all records, by benchmark."""
    found: dict[str, list[tuple[Path, Record]]] = {}
    for path in sorted(records.rglob("*.json")):
        record = read_record(path)
        found.setdefault(record.bench, []).append((path, record))
    return found
