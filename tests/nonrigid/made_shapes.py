"""Made shapes for the tests of the room."""

import numpy as np

from marey.geometry import rotations


def without_motion(modes, mean):
    """Take translation and turn of the mean (P, 3) out of displacements (M, P, 3)."""
    motions = np.concatenate([np.tile(np.eye(3), (len(mean), 1, 1)), rotations.hat(mean)], 2).reshape(-1, 6)
    q = np.linalg.qr(motions)[0]
    flat = modes.reshape(len(modes), 3 * len(mean))
    return (flat - flat @ q @ q.T).reshape(modes.shape)
