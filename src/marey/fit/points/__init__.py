"""Fit of a body to measured surface points and their trajectories."""
