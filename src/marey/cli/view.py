"""The command `marey view`."""

from pathlib import Path
from typing import Annotated

import typer

from marey.errors import FileProblem

_PAGES = ("report.html", "surface.html", "knee.html")
"""Names of the pages that commands write, the preferred one first."""


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
