"""Likely causes of data that contradict each other, each tested by trying its repair."""
