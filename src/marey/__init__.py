"""Measures how a body moves and what shape it has, from what is seen at its surface."""

__version__ = "0.1.0"
