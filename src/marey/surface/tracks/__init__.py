"""The surface followed through the frames: trajectories and their filters."""
