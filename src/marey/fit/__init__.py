"""Estimation of pose and shape parameters from all observations by least squares."""
