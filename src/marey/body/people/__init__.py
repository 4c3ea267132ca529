"""Variation among people: the statistical family of bodies, measurements, and one person's body."""
