"""The commands `marey view` and `marey bench`, which show reports and speeds."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from marey.cli.options import require_trial
from marey.cli.work import working
from marey.errors import FileProblem

_PAGES = ("report.html", "surface.html", "knee.html")
"""Names of the pages that commands write, the preferred one first."""
_COLUMNS_IN_FILES = 200
"""Width of the table of speeds where the output is not a terminal [characters]."""


def view(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A folder of results, or a page in it.")],
    no_browser: Annotated[
        bool, typer.Option("--no-browser", metavar="", help="Only print the path of the report.")
    ] = False,
) -> None:
    """Show the report of a run in the browser; the paths of further reports in the folder are printed.

    Example: `marey view walk01/marey`
    """
    import webbrowser

    report = _report_in(folder)
    typer.echo(report)
    for other in [report.with_name(name) for name in _PAGES if report.name != name]:
        if other.is_file():
            typer.echo(f"Further report: {other}", err=True)
    if not no_browser:
        webbrowser.open(report.as_uri())


def _report_in(folder: Path) -> Path:
    if folder.suffix.lower() == ".html" and folder.is_file():
        return folder.resolve()
    for name in _PAGES:
        for report in (folder / name, folder / "marey" / name, folder / "knee" / name):
            if report.is_file():
                return report.resolve()
    wrong = f"holds no {' or '.join(_PAGES)}" if folder.is_dir() else "does not exist"
    raise FileProblem(folder, wrong, "Give the folder with the results of a command.")


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

    if trial is not None:
        require_trial(trial)
    with working(parallel_cameras=True) as progress:
        speeds = measure_speeds(trial, example=example_folder(), progress=progress)
    title = f"marey bench on {machine()}; times of one core"
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for heading in ("what", "measured", "compared with", "remark"):
        table.add_column(heading, overflow="fold")
    for speed in speeds:
        table.add_row(*map(escape, (speed.what, speed.measured, speed.beside, speed.remark)))
    Console(width=None if sys.stdout.isatty() else _COLUMNS_IN_FILES).print(table)
