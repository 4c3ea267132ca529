"""Units of length in files."""

METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
"""Units of length that a file may use, in metres."""
MM_PER_M = 1e3
"""Number of millimetres per metre."""
