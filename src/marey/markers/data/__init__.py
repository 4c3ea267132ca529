"""Trajectories, clusters and calibrations: the input and output of every marker method."""
