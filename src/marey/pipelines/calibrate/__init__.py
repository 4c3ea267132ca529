"""Calibration of cameras from a folder of videos or pictures of a board."""
