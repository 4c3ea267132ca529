"""Synthetic shapes and cameras for the tests of this package."""

import numpy as np

from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform


def without_motion(modes, mean):
    """Take translation and turn of the mean (P, 3) out of displacements (M, P, 3)."""
    motions = np.concatenate([np.tile(np.eye(3), (len(mean), 1, 1)), rotations.hat(mean)], 2).reshape(-1, 6)
    q = np.linalg.qr(motions)[0]
    flat = modes.reshape(len(modes), 3 * len(mean))
    return (flat - flat @ q @ q.T).reshape(modes.shape)


def three_cameras(degrees=20.0):
    """Cameras 2 m before the origin, so many degrees apart, with a lens."""
    upright = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    turns = rotations.exp(np.radians(degrees) * np.array([[0, 0, -1.0], [0, 0, 0], [0, 0, 1.0]]))
    return Rig(
        tuple(
            Camera(
                name=f"cam{number}",
                size=(960, 720),
                matrix=np.array([[900.0, 0, 480], [0, 900.0, 360], [0, 0, 1.0]]),
                distortion=np.array([-0.1, 0.02, 0.0, 0.0]),
                camera_from_world=RigidTransform(upright @ turn, np.array([0, 0, 2.0])),
            )
            for number, turn in enumerate(turns)
        )
    )
