"""A motion over time, and the angles that anatomists read from it."""
