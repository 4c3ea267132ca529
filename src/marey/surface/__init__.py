"""The visible surface: measured in several images at once, and followed over time."""
