"""Reading of pages (HTML) that commands wrote."""

from pathlib import Path

from marey.errors import FileProblem

VIEWER_MARK = b"marey view</title>"
"""Text near the beginning of each page of `marey view`."""
_HEAD_BYTES = 4096
"""Length of the beginning of a page in which the mark is searched [bytes]. Chosen by hand."""
_LARGEST_BYTES = 200_000_000
"""Largest page that is read [bytes]; reports have a few megabytes. Chosen by hand."""


def read_page(path: Path) -> bytes | None:
    """Read a page.

    Args:
        path: The file.

    Returns:
        Its content; None if there is no such file.

    Raises:
        FileProblem: It cannot be read, or is far larger than any report.
    """
    try:
        if not path.is_file():
            return None
        if path.stat().st_size > _LARGEST_BYTES:
            raise FileProblem(path, "is larger than any report", "Remove it, or run the command again.")
        return path.read_bytes()
    except OSError as error:
        raise FileProblem(path, f"cannot be read ({error.strerror})", "Check the access rights.") from error


def is_own_page(path: Path) -> bool:
    """Return whether a file is a page of `marey view`.

    Args:
        path: The file.
    """
    try:
        with path.open("rb") as file:
            return VIEWER_MARK in file.read(_HEAD_BYTES)
    except OSError:
        return False
