"""Correspondence between the points of several cameras."""
