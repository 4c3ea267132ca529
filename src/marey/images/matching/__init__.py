"""Matching patches between pictures and following points through a video."""
