"""Benchmarks of surfaces, patch matching, trajectories and shape."""
