"""What surrounds the work of every command: settings of the process, progress display, and the verdict at the end."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from marey.pipelines.verdict import Verdict

if TYPE_CHECKING:
    from marey.cli.progress import TerminalProgress

NOT_USABLE = 3
"""Exit code if the verdict is "not usable", or a run ended without a usable answer; its cause is named."""


@contextmanager
def working(
    *, quiet: bool = False, parallel_cameras: bool = False, workers: int | None = None, kernels: str | None = None
) -> "Iterator[TerminalProgress]":
    """Set the process up for a command's work, and show its progress.

    Args:
        quiet: Show nothing but warnings.
        parallel_cameras: Whether the command works on several videos in parallel.
        workers: Largest number of cores that work at the same time; by default all that the process may use.
        kernels: Name of a list of kernels that are compiled ahead where they are missing, see `marey.compiled.ahead`.

    Yields:
        The progress display.
    """
    # Imported here, so that help appears at once.
    from marey.cli.compilation import observed_compilation
    from marey.cli.progress import TerminalProgress
    from marey.compiled.ahead import compiled_ahead
    from marey.process import tuned_process, usable_cores

    progress = TerminalProgress(quiet=quiet)
    with ExitStack() as around:
        around.enter_context(tuned_process(parallel_cameras=parallel_cameras, workers=workers))
        around.enter_context(observed_compilation(progress.compilation))
        if kernels is not None:
            around.enter_context(compiled_ahead(kernels, processes=usable_cores()))
        yield progress


def end_with_verdict(verdict: Verdict | None, **paths: Path | None) -> None:
    """Print the verdict and where the results are, the page to open last; exit with the code of the verdict.

    Args:
        verdict: The verdict; None for a result that has none.
        **paths: A file or folder by what it is, for example `report`; None is not printed.

    Raises:
        typer.Exit: The result is not usable.
    """
    if verdict is not None:
        typer.echo(str(verdict))
    for what, path in paths.items():
        if path is not None:
            typer.echo(f"{what.capitalize()}: {path}")
    if verdict is not None and not verdict.usable:
        raise typer.Exit(NOT_USABLE)
