"""Small people whose every number is known, made by the tests themselves."""

import numpy as np

from marey.body.articulation.pose import Pose, SkinPoints
from marey.body.articulation.skeleton import Skeleton, full_skeleton
from marey.body.articulation.surface import Body, ShapeSpace

ARM = np.array([0.67, -0.02, -0.74])


def skeleton() -> Skeleton:
    return full_skeleton(arm=ARM, elbow=np.array([-0.7, 0.2, -0.68]), palm=np.array([-0.7, 0.1, -0.6]))


def stick_person(rng: np.random.Generator, *, vertices: int = 200, numbers: int = 5) -> Body:
    """A person of random triangles: of no looks, but every weight, mode and face is there."""
    bones = skeleton()
    count = len(bones.segment_names)
    joints = np.zeros((count, 3))
    for k, parent in enumerate(bones.parents):
        if parent >= 0:
            joints[k] = joints[parent] + rng.normal(size=3) * 0.2
    owner = rng.integers(0, count, vertices)
    segments = np.zeros((vertices, 4), int)
    segments[:, 0] = owner
    segments[:, 1] = np.maximum(bones.parents[owner], 0)
    weights = np.zeros((vertices, 4))
    weights[:, 0] = rng.uniform(0.4, 1.0, vertices)
    weights[:, 1] = 1 - weights[:, 0]
    space = ShapeSpace(
        names=tuple(f"number_{i}" for i in range(numbers)),
        vertex_mean=joints[owner] + rng.normal(size=(vertices, 3)) * 0.1,
        vertex_modes=rng.normal(size=(numbers, vertices, 3)) * 0.02,
        joint_mean=joints,
        joint_modes=rng.normal(size=(numbers, count, 3)) * 0.02,
        prior_mean=np.zeros(numbers),
        prior_covariance=np.diag(rng.uniform(0.5, 2.0, numbers)),
    )
    return Body(
        skeleton=bones, space=space, numbers=rng.normal(size=numbers),
        faces=rng.integers(0, vertices, (2 * vertices, 3)), vertex_segments=segments, vertex_weights=weights,
    )  # fmt: skip


def any_pose(rng: np.random.Generator, body: Body, *, spread: float = 0.4) -> Pose:
    rest = Pose(np.zeros(3), np.eye(3), np.zeros(len(body.skeleton) - 6))
    change = rng.normal(size=len(body.skeleton)) * spread
    change[:3] = rng.normal(size=3) * 2
    return rest.step(change)


def any_points(rng: np.random.Generator, body: Body, count: int) -> SkinPoints:
    return SkinPoints(face=rng.integers(0, len(body.faces), count), barycentric=rng.dirichlet([1.0, 1.0, 1.0], count))
