"""Estimation of the clocks of cameras that were not started together."""
