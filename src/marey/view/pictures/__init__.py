"""Single images: overlays, surfaces, slices."""
