"""From pixels to measurements, knowing nothing of bodies."""
