"""Reference implementation of the level-set kernel's votes, in NumPy."""

import numpy as np

from marey.arrays import Mask
from marey.images.silhouettes.level_sets import LENGTH_REACH, WEIGHTS


def votes(evidence: np.ndarray, inside: Mask, *, length: float) -> np.ndarray:
    """Return the decrease of the energy if a pixel is inside rather than outside, (H, W); reference for the kernel."""
    padded = np.pad(inside.astype(np.float64), LENGTH_REACH, mode="edge")
    height, width = inside.shape
    share = np.zeros(inside.shape)
    for i in range(2 * LENGTH_REACH + 1):
        for j in range(2 * LENGTH_REACH + 1):
            share += WEIGHTS[i, j] * padded[i : i + height, j : j + width]
    return evidence + length * (2 * share - 1)
