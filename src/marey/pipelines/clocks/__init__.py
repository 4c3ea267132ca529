"""Checks of clocks during a run: those of the cameras, and those of two motions that are compared."""
