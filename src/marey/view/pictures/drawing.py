"""Constants shared by the drawings over camera images."""

LONGEST_SIDE = 1280
"""Largest side of an overlay [px]; larger images are halved until they fit. Chosen by hand."""
FRACTION_BITS = 4
"""Number of fractional bits in the coordinates that OpenCV draws, for positions in steps of 1/16 px."""
FARTHEST = 1e5
"""Points with larger coordinates, and NaN, are not drawn [px]; far within the 32-bit range of OpenCV."""
