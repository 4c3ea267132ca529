"""Names from files that become parts of the names of results: plain names, on every system."""

from collections.abc import Iterable
from pathlib import Path

from marey.errors import FileProblem

LONGEST_NAME = 100
"""Largest length of a name [characters]. Chosen by hand."""
_LONGEST_BYTES = 200
"""Largest length of a name in UTF-8 [bytes]: systems allow 255 for a file name, and names are only a part of it."""
_FORBIDDEN = '<>:"|?*'
"""Characters that Windows allows in no file name, besides separators."""
_RESERVED = frozenset({"con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in range(1, 10))})
"""Names of devices, which Windows allows as no file name, in lower case."""


def name_faults(name: str) -> list[str]:
    """List what prevents a name from being a part of file names, each as a clause ("has ...").

    Args:
        name: The name of a camera, a segment or the like.

    Returns:
        At most one clause; none if the name can be used.
    """
    if not name.strip():
        return ["has no name"]
    if len(name) > LONGEST_NAME:
        return [f"has a name of {len(name)} characters; at most {LONGEST_NAME} are allowed"]
    if "/" in name or "\\" in name or name in (".", ".."):
        return ["has a name that is a path; it must be a plain name, such as cam01"]
    if not name.isprintable():
        return ["has a name with control characters; it must be a plain name, such as cam01"]
    if len(name.encode()) > _LONGEST_BYTES:
        return [f"has a name of {len(name.encode())} bytes; at most {_LONGEST_BYTES} are allowed"]
    if set(name) & set(_FORBIDDEN):
        return [f"has a name with one of the characters {_FORBIDDEN}, which file names cannot have on every system"]
    if name[-1] in ". " or name[0] == " " or name.partition(".")[0].strip().lower() in _RESERVED:
        return ["has a name that cannot be a file name on every system; it must be a plain name, such as cam01"]
    return []


def shown_name(name: str) -> str:
    """Return a name as an error message shows it: on one line, and not too long."""
    return (name if name.isprintable() else ascii(name)[1:-1])[:LONGEST_NAME]


def require_plain_names(path: Path, names: Iterable[str], *, kind: str) -> None:
    """Check names that a file defines.

    Args:
        path: The file.
        names: The names.
        kind: What they name, for example "segment".

    Raises:
        FileProblem: A name cannot be a part of file names.
    """
    for name in names:
        for fault in name_faults(name):
            raise FileProblem(path, f"{kind} '{shown_name(name)}' {fault}", f"Rename this {kind}.")
