"""Check of the clocks of the cameras during a run."""
