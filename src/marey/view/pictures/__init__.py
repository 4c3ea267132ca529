"""Single pictures: overlays, surfaces, slices."""
