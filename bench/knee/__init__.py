"""Benchmarks of knees from magnetic resonance images."""
