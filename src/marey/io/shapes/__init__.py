"""Measured surfaces, tracks, trajectories and recovered shapes."""
