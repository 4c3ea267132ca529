"""Atomic writing of files: a file is complete or absent."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from marey.errors import FileProblem


@contextmanager
def replacing(path: Path | str) -> Iterator[Path]:
    """Provide a temporary path in the same folder, which is renamed to the wanted path if no error occurs.

    Args:
        path: The file to write; its folder is created if it does not exist.

    Yields:
        A temporary path in the same folder with the same suffix.

    Raises:
        FileProblem: The folder cannot be written to.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()
    except OSError as error:
        remedy = "Choose another folder for the results (--out)."
        raise FileProblem(path, f"cannot be written ({error.strerror})", remedy) from error
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
