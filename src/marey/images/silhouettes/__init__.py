"""Silhouettes of a person: background models, colour densities, level sets, contours."""
