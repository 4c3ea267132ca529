"""The command `marey study`."""

from pathlib import Path
from typing import Annotated

import typer

from marey.cli.options import Quiet
from marey.cli.work import end_with_verdict, working


def study(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder with study.toml and the trials.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="DIR", help="Folder for the results. [default: FOLDER/results]"),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(metavar="N", help="Number of worker processes on this computer. [default: one per core]"),
    ] = None,
    memory: Annotated[
        float | None,
        typer.Option(
            metavar="GB",
            help="Memory of each worker process, above which it is ended. [default: an equal share of all memory]",
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Use the workers of an existing scheduler of dask.distributed, such as tcp://node01:8786.",
        ),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Run the same steps on every trial of a folder, and write one table and one page.

    `study.toml` states where the trials are and what is done with each. What is done is not done again: after an
    interruption, or when trials were added, the same command continues. A trial that fails is named and costs only
    itself.

    Examples:
    * `marey study gait_study`
    * `marey study gait_study --workers 8 --memory 3`
    * `marey study gait_study --scheduler tcp://node01:8786 --out /shared/results`
    """
    from marey.pipelines.study.study import run_study

    with working(quiet=quiet) as progress:
        found = run_study(
            folder, out=out, workers=workers, memory_gb=memory, scheduler=scheduler, progress=progress
        )  # fmt: skip
    end_with_verdict(found.verdict, table=found.folder / "study.csv", report=found.report)
