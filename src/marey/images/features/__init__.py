"""Features of an image beyond its colours: texture channels from edge-preserving smoothing."""
