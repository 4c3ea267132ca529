"""Patches of the body's surface, tracked through the images for the refinement of a motion."""
