"""Contradictions between the cameras of a take, and what would explain them."""
