"""Drawing of single pictures: overlays, surfaces, slices and plots."""
