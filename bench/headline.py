"""The headline figures of docs/accuracy.md: which cells of which records they are."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.declaration import Bench
from bench.provenance import PROJECT, age
from bench.recording import Record, Table, record_path

BEGIN, END = "<!-- headline figures: written by `python -m bench report` -->", "<!-- end of the headline figures -->"
"""The lines of docs/accuracy.md between which the table stands."""


@dataclass(frozen=True)
class Headline:
    """One row of the headline table.

    Attributes:
        quantity: What is measured, and on what.
        record: Name of the record, without `.json`.
        table: Beginning of the table's title.
        column: Name of the column.
        rows: The labels of the rows whose cells are listed; a label column is matched by its beginning.
    """

    quantity: str
    record: str
    table: str
    column: str
    rows: Sequence[Sequence[str]]


def takes(quantity: str, column: str, names: str) -> Headline:
    """A quantity of several captured takes."""
    return Headline(
        f"{quantity} ({names})", "capture/takes", "All cameras", column, [[name] for name in names.split(", ")]
    )


def rooms(quantity: str, column: str) -> Headline:
    """A quantity of the rendered takes without images of the empty room."""
    names = ("jacks", "market", "office")
    rows = [[name] for name in names]
    return Headline(f"{quantity} ({', '.join(names)})", "capture/rooms", "With detected key points", column, rows)


RENDERED = "walk, reach, stealth, jacks"
HEADLINES = (
    takes("Joint centres of rendered takes, four cameras", "joints", RENDERED),
    takes("The same without each joint's constant offset", "steady", RENDERED),
    takes("Surface against true masks, intersection over union", "surface IoU", RENDERED),
    takes("True errors within the stated 95 % intervals", "95 % intervals hold", RENDERED),
    takes("Joint centres of a real take against detected key points", "joints", "balancing"),
    rooms("Joint centres without images of the empty room, with detected joints", "joints"),
    rooms("The same, silhouettes against true masks, intersection over union", "silhouettes IoU"),
    rooms("The same, true errors within the stated 95 % intervals", "95 % intervals hold"),
    Headline("Points of a rendered arm, median distance", "surface/arm.default", "Points", "median", [["default"]]),
    Headline("Its trajectories, drift after 41 frames", "surface/arm.default", "Trajectories", "drift", [["default"]]),
    Headline(
        "Radius of a real cylinder in five positions (57.225 +- 0.05 mm by an independent program)",
        "surface/cylinder",
        "`marey surface`",
        "radius",
        [[str(n), "13"] for n in range(1, 6)],
    ),
    Headline(
        "Real faces, pairs of views agree within (instants 2, 3, 5)",
        "surface/faces",
        "Faces",
        "pairs agree within, median",
        [["alone", n] for n in "235"],
    ),
    Headline(
        "Knee angles by `skin` against the rigid fit, six real trials (one posture, two)",
        "markers/trials",
        "Methods",
        "mean against rigid",
        [["skin", "1"], ["skin", "2"]],
    ),
    Headline("The same, worst trial", "markers/trials", "Methods", "worst", [["skin", "1"], ["skin", "2"]]),
    Headline(
        "True errors within the stated 95 % intervals, `skin`",
        "markers/trials",
        "Methods",
        "95 % hold",
        [["skin", "1"], ["skin", "2"]],
    ),
    Headline(
        "Shapes before one camera, metric A (drink, pickup, stretch, face)",
        "nonrigid/one_camera",
        "Shapes",
        "metric A",
        [["drink"], ["pickup"], ["stretch"], ["face"]],
    ),
    Headline(
        "Shapes in perspective, error of the paper's video",
        "nonrigid/perspective",
        "Paper, ten",
        "shape_percent",
        [["paper"]],
    ),
    *(
        Headline(
            f"Bones against references, {bone}: Dice / mean / 95 % distance [mm] (real `dess`, simulated `phantom_a`)",
            "knee/bones",
            "Bones",
            f"{bone}: Dice / ASD [mm] / HD95 [mm]",
            [["dess"], ["phantom_a"]],
        )
        for bone in ("femur", "tibia", "patella")
    ),
    Headline(
        "Cartilage of `phantom_a` (femoral, tibial, patellar), thickness map",
        "knee/cartilage.phantom-a.segmented",
        "Cartilage",
        "map",
        [["phantom_a", kind] for kind in ("femoral", "tibial", "patellar")],
    ),
    Headline(
        "Gadolinium balls in simulated volumes (phantom_a, phantom_spl, phantom_spl_t1)",
        "knee/gadolinium",
        "Balls of",
        "error, RMS",
        [["phantom_a"], ["phantom_spl"], ["phantom_spl_t1"]],
    ),
    Headline(
        "Calibration error of stated intervals (joint centres, surface points, bones by `skin`, shapes by one camera)",
        "intervals/coverage",
        "Stated intervals",
        "calibration error",
        [
            ["motion", "joint centres, all cameras"],
            ["surface", "points"],
            ["bones", "rotations, `skin`, one posture"],
            ["one-camera", "shapes"],
        ],
    ),
)


def with_headlines(
    text: str, records: Mapping[Path, Record], benches: Mapping[str, Bench], folder: Path, project: Path = PROJECT
) -> str:
    """Replace the headline table of a page.

    Args:
        text: The page, with the lines `BEGIN` and `END`.
        records: The records by their files.
        benches: The declarations by name.
        folder: The folder of the records.
        project: The repository whose history gives the records' age.

    Returns:
        The page with the table between these lines.

    Raises:
        ValueError: If the page lacks the lines.
    """
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError("docs/accuracy.md lacks the lines between which the headline figures stand.")
    lines = ["| quantity | result | measured |", "| --- | --- | --- |"]
    for headline in HEADLINES:
        record = records.get(record_path(headline.record, [], folder))
        value = cells(headline, record) if record else "not measured"
        lines.append(f"| {headline.quantity} | {value} | {source(headline, record, benches, project)} |")
    return "\n".join([f"{before}{BEGIN}", *lines, f"{END}{after}"])


def cells(headline: Headline, record: Record) -> str:
    """The cells of a headline, with the unit."""
    table = next((each for each in record.tables if each.title.startswith(headline.table)), None)
    if table is None:
        return "not measured"
    column = next((each for each in table.columns if each.name == headline.column), None)
    if column is None:
        return "not measured"
    values = [_cell(table, labels, headline.column) for labels in headline.rows]
    return f"{', '.join(values)} {column.unit}".strip()


def _cell(table: Table, labels: Sequence[str], column: str) -> str:
    index = [each.name for each in table.columns].index(column)
    for named, values in table.rows:
        if all(name.startswith(label) for name, label in zip(named, labels, strict=False)):
            return table.columns[index].text(values[index])
    return "-"


def source(headline: Headline, record: Record | None, benches: Mapping[str, Bench], project: Path) -> str:
    """The page of a headline, with the commit and the mark of an old record."""
    group, name = headline.record.split("/")
    link = f"[{name.partition('.')[0]}](accuracy/{group}.md)"
    if record is None:
        return link
    if record.source:
        return f"{link}, **not re-measured**"
    bench = benches[record.bench]
    old = ", **old**" if age(record.commit, [*bench.sources, bench.file], project).old else ""
    return f"{link}, {record.commit[:7]}{old}"
