"""Gadolinium markers, and the correspondence between scanner and laboratory."""
