"""Benchmarks of skin markers, bones and joint angles."""
