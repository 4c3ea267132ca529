"""From pixels to measurements, without a body model."""
