"""Writing beside and renaming: a file is there whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from marey.errors import FileProblem


@contextmanager
def replacing(path: Path | str) -> Iterator[Path]:
    """Give a path beside the wanted one to write to; it takes the wanted one's place when all went well.

    Args:
        path: The file to be written; its folder is made where it is missing.

    Yields:
        A path in the same folder with the same ending.

    Raises:
        FileProblem: The folder cannot be written to.
    """
    path = Path(path)
    beside = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.touch()
    except OSError as error:
        raise FileProblem(path, f"cannot be written ({error.strerror})", "Choose another folder with --out.") from error
    try:
        yield beside
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)
