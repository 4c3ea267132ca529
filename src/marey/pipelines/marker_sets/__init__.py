"""Segments, landmarks and joint centres of trials with a known marker set."""
