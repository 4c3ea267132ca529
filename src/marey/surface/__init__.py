"""The visible surface: measured in several pictures at once, and followed over time."""
