"""Drawing of single images: overlays, surfaces, slices and plots."""
