"""A small person, moved and seen: for the tests of everything that draws."""

import numpy as np

from marey.body.articulation.pose import PosedBody
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.geometry.rigid import RigidTransform
from marey.motion.motion import FILLED, LOST, MEASURED, NO_PERSON, BodyMotion
from tests.people import any_pose, stick_person

FRAMES = 12


def camera(name: str = "cam01", *, size: tuple[int, int] = (160, 120), distance: float = 4.0) -> Camera:
    """Looks along the world's y at a person who stands at its origin."""
    rotation = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    return Camera(
        name=name, size=size, matrix=np.array([[150.0, 0, size[0] / 2], [0, 150, size[1] / 2], [0, 0, 1]]),
        distortion=np.zeros(4), camera_from_world=RigidTransform(rotation, np.array([0, 0, distance])),
    )  # fmt: skip


def rig() -> Rig:
    return Rig((camera("cam01"), camera("cam02", distance=5.0)))


def small_take(rng: np.random.Generator) -> tuple[BodyMotion, list[PosedBody]]:
    """A motion whose first frames are empty, one is filled and one lost, and the poses it was made of."""
    body = stick_person(rng, vertices=60)
    posed = [PosedBody(body, any_pose(rng, body)) for _ in range(FRAMES)]
    segments = body.skeleton.segment_names
    joints, degrees = body.joint_segments, len(body.skeleton)
    state = np.full(FRAMES, MEASURED)
    state[:2], state[5], state[8] = NO_PERSON, FILLED, LOST
    gone = np.isin(state, (NO_PERSON, LOST))
    rotation = np.stack([p.segment_rotation for p in posed])
    origin = np.stack([p.segment_origin for p in posed])
    rotation[gone], origin[gone] = np.nan, np.nan
    coordinates = np.where(gone[:, None], np.nan, rng.normal(size=(FRAMES, degrees)))
    determined = np.ones((FRAMES, degrees), bool)
    determined[:, 10] = False
    angles = np.where(gone[:, None], np.nan, rng.normal(size=(FRAMES, 3)) * 20)
    agreement = np.where(gone[:, None], np.nan, np.full((FRAMES, 2), 0.93))
    agreement[6, 1] = 0.5
    motion = BodyMotion(
        time=np.arange(FRAMES) / 30, rate=30.0, joint_names=body.joint_names, joint_centres=origin[:, joints],
        joint_centres_sd=np.where(np.isnan(origin[:, joints]), np.nan, 0.004), segment_names=segments,
        segment_rotation=rotation, segment_origin=origin, coordinate_names=body.skeleton.coordinate_names,
        coordinates=coordinates, coordinates_sd=np.abs(coordinates), determined=determined,
        angle_names=("trunk_flexion", "left_knee_flexion", "right_knee_flexion"), angles_deg=angles,
        angles_deg_sd=np.abs(angles) * 0.1, state=state, camera_names=("cam01", "cam02"), agreement=agreement,
    )  # fmt: skip
    return motion, posed
