"""Factorisation of points in space, and of points in calibrated cameras."""
