"""The example take that is distributed with the package."""

import sys
from pathlib import Path

import marey
from marey.errors import FileProblem


def example_folder() -> Path:
    """Return the folder of the example take: in the clone, or where the package was installed.

    Returns:
        The trial `reach`: four cameras, 130 frames.

    Raises:
        FileProblem: The example is in neither place.

    Example:
        >>> import marey
        >>> marey.example_folder().name
        'reach'
    """
    clone = Path(marey.__file__).resolve().parents[2] / "examples" / "reach"
    installed = Path(sys.prefix) / "share" / "marey" / "examples" / "reach"
    for folder in (clone, installed):
        if (folder / "cameras.toml").is_file():
            return folder
    raise FileProblem(clone, "does not exist", "Use a clone of the project, which contains the example.")
