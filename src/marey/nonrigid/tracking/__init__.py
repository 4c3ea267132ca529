"""Tracks of all points solved together under a low rank."""
