"""From videos, tracks or points to the shapes of a deforming surface."""
