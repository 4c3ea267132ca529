"""The commands `marey view` and `marey bench`, which show results and speeds."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from marey.cli.options import Quiet, require_trial
from marey.cli.work import working
from marey.errors import FileProblem

_PAGES = ("report.html", "surface.html", "knee.html")
"""Names of the pages that commands write, the preferred one first."""
_COLUMNS_IN_FILES = 200
"""Width of the table of speeds where the output is not a terminal [characters]."""


def view(
    folders: Annotated[
        list[Path],
        typer.Argument(metavar="DIR [DIR]", help="A folder of results, or two to compare; or a page of a command."),
    ],
    trial: Annotated[
        Path | None,
        typer.Option("--trial", metavar="TRIAL", help="The trial with the videos. [default: the one above DIR]"),
    ] = None,
    offset: Annotated[
        float,
        typer.Option(
            "--offset",
            metavar="S",
            help="Seconds that are added to the times of the second result. [default: 0]",
            show_default=False,
        ),
    ] = 0.0,
    file: Annotated[
        Path | None,
        typer.Option("--file", metavar="FILE", help="Write the page as one HTML file that needs no server."),
    ] = None,
    port: Annotated[
        int,
        typer.Option(
            metavar="N",
            min=0,
            max=65535,
            help="Port of the page's address. [default: any free one]",
            show_default=False,
        ),
    ] = 0,
    report: Annotated[
        bool, typer.Option("--report", metavar="", help="Open the report of the command instead.")
    ] = False,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", metavar="", help="Print the address, or the path, without opening it.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Show results in the browser: videos with the body over them, a 3-D view, and curves, all at one time.

    Results of `marey capture`, `marey shape` and `marey markers` are shown, one or two side by side. The page can be
    opened only on this computer, also through an SSH tunnel; Ctrl-C ends the command. Of other results, the report is
    opened.

    Examples:
    * `marey view walk01/marey`
    * `marey view before after --trial walk01`
    * `marey view walk01/marey --file walk01.html`
    """
    import webbrowser

    from marey.pipelines.viewer.viewer import serve_viewer, viewer_content, viewer_server, write_viewer

    if report or not all(map(_has_motion, folders)):
        _show_report(folders, no_browser=no_browser)
        return
    with working(quiet=quiet) as progress:
        content = viewer_content(folders, trial, progress, offset_s=offset)
        if file is not None:
            write_viewer(content, file, progress)
        else:
            server = viewer_server(content, port)
    if file is not None:
        typer.echo(file)
        if not no_browser:
            webbrowser.open(file.resolve().as_uri())
        return
    typer.echo(f"The page is at {server.address}. Ctrl-C ends it.")
    if not no_browser:
        webbrowser.open(server.address)
    serve_viewer(server)


def _has_motion(folder: Path) -> bool:
    """Return whether a path is a folder of results, or a file of them, that the viewer can show."""
    if folder.is_file():
        return folder.name in ("motion.npz", "bones.npz")
    places = [folder, folder / "marey"]
    # Bones of other commands than `marey markers` have no markers beside them.
    return any(
        (place / "motion.npz").is_file() or ((place / "bones.npz").is_file() and (place / "motion.c3d").is_file())
        for place in places
    )


def _show_report(folders: Sequence[Path], *, no_browser: bool) -> None:
    import webbrowser

    if len(folders) > 1:
        found = [folder for folder in folders if not _has_motion(folder)] or folders
        wrong = "holds neither motion.npz nor bones.npz" if found[0].is_dir() else "does not exist"
        raise FileProblem(found[0], wrong, "To compare, give two folders with results of capture, shape or markers.")
    page = _report_in(folders[0])
    typer.echo(page)
    for other in [page.with_name(name) for name in _PAGES if page.name != name]:
        if other.is_file():
            typer.echo(f"Further report: {other}", err=True)
    if not no_browser:
        webbrowser.open(page.as_uri())


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
