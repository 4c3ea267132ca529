"""Calibration of cameras from pictures of a printed board: corners, joint adjustment, and how good the result is."""
