"""Cameras from a person: found again by silhouettes, refined with the motion, or from detected joints alone."""
