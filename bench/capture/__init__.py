"""Benchmarks of capture from calibrated videos."""
