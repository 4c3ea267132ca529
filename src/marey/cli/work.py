"""What surrounds the work of every command: the process's settings and the progress display."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from marey.cli.progress import TerminalProgress


@contextmanager
def working(*, quiet: bool = False, parallel_cameras: bool = False) -> "Iterator[TerminalProgress]":
    """Set the process up for a command's work, and show its progress.

    Args:
        quiet: Show nothing but warnings.
        parallel_cameras: Whether the command works on several videos in parallel.

    Yields:
        The progress display.
    """
    # Imported here, so that help appears at once.
    from marey.cli.compilation import observed_compilation
    from marey.cli.progress import TerminalProgress
    from marey.process import tuned_process

    progress = TerminalProgress(quiet=quiet)
    with tuned_process(parallel_cameras=parallel_cameras), observed_compilation(progress.compilation):
        yield progress
