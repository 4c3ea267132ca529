"""Tracking of a surface over the frames: trajectories and their filters."""
