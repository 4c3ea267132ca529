"""The gait of a walk: its events, cycles and parameters, their files, and their part of a page."""
