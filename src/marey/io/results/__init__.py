"""The files that a capture leaves."""
