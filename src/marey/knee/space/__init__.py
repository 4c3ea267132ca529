"""Volumes, surfaces and the geometry on them."""
