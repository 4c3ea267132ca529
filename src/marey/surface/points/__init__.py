"""Points of the visible surface, measured in several pictures of one instant."""
