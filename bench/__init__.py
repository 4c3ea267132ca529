"""Benchmarks: what marey measures, how well, and how fast. See bench/README.md."""
