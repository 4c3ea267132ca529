"""Benchmarks of non-rigid factorisation and of points followed in video."""
