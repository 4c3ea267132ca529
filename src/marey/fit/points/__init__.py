"""Fitting a body to measured surface points and their trajectories."""
