"""Offsets and drifts of the clocks of cameras that were not started together, from what they show in common."""
