"""Cameras that are not where their calibration places them, and cameras from a person."""
