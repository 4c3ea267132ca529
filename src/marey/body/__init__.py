"""Parametric model of the human body."""
