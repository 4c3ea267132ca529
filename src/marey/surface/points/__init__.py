"""Measurement of points of the visible surface from several images of one instant."""
