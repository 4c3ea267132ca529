"""Matching of patches between images and tracking of points through a video."""
