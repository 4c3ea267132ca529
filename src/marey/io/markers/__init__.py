"""Marker trajectories and bones: C3D, TRC, CSV and result files."""
