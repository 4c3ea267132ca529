"""Printed boards: their corners in space, and how the corners are found in pictures."""
