"""Quantities of many trials: means over subjects with intervals, differences of conditions, and outliers."""
