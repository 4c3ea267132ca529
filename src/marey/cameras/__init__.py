"""Calibrated cameras: projection of points to pixels, and rays of pixels."""
