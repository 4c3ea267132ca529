"""Units of length in files."""

from marey.errors import MareyError

METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
"""Units of length that a file may use, in metres."""
MM_PER_M = 1e3
"""Number of millimetres per metre."""


def require_unit(unit: str | None) -> None:
    """Check the unit with which a user overrides that of a file.

    Args:
        unit: The unit; None keeps that of the file.

    Raises:
        MareyError: The unit is none of `METRES`.
    """
    if unit is not None and unit not in METRES:
        raise MareyError(f"The unit {unit!r} is unknown. It should be one of {', '.join(METRES)}.")
