"""Cameras from a person: found again by silhouettes, and refined with the motion."""
