"""Trajectories, clusters and calibrations: what every marker method works on."""
