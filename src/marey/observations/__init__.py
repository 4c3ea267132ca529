"""Observations: measurements with their prediction and uncertainty, under one interface with one module per kind."""
