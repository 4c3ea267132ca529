"""The command `marey bench`."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from marey.cli.work import working

_COLUMNS_IN_FILES = 200
"""Width of the table where the output is not a terminal [characters]."""


def bench(
    trial: Annotated[
        Path | None, typer.Argument(metavar="[TRIAL]", help="A trial on which all steps from video to pose are timed.")
    ] = None,
) -> None:
    """Measure the speed of the main steps, each compared with another program or with a limit.

    Examples: `marey bench`, `marey bench examples/reach`
    """
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from marey.io.trial.example import example_folder
    from marey.pipelines.speed.speeds import machine, measure_speeds

    with working(parallel_cameras=True) as progress:
        speeds = measure_speeds(trial, example=example_folder(), progress=progress)
    title = f"marey bench on {machine()}; times of one core"
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for heading in ("what", "measured", "compared with", "remark"):
        table.add_column(heading, overflow="fold")
    for speed in speeds:
        table.add_row(*map(escape, (speed.what, speed.measured, speed.beside, speed.remark)))
    Console(width=None if sys.stdout.isatty() else _COLUMNS_IN_FILES).print(table)
