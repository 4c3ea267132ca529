"""People of metaballs whose numbers are known, and points measured on them."""

from dataclasses import replace

import numpy as np

from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.body.metaballs.metaball_person import MetaballSpace, metaball_body, metaball_space, vertex_limbs
from marey.body.metaballs.metaballs import PosedMetaballs
from marey.fit.points.surface_points import FramePoints

ARM = ("shoulder_sweep", "shoulder_lift", "shoulder_turn", "elbow_flexion", "pronation", "wrist_flexion")


def arm_space() -> MetaballSpace:
    """The simple person's lengths and widths, of whom the right arm's joints turn only."""
    space = metaball_space("simple")
    skeleton = space.mean.skeleton
    names = [f"right_{name}" for name in ARM]
    kept = tuple(c for c in skeleton.coordinates if c.name in names)
    return replace(space, mean=replace(space.mean, skeleton=replace(skeleton, coordinates=kept)))


def person(space: MetaballSpace, numbers: np.ndarray) -> Body:
    return replace(metaball_body(space, numbers), skeleton=space.mean.skeleton)


def arm_poses(rng: np.random.Generator, count: int) -> list[Pose]:
    """An arm that bends: every frame another place of the body, too."""
    poses = []
    for _ in range(count):
        angles = np.deg2rad([*rng.uniform(-25, 25, 3), rng.uniform(20, 90), *rng.uniform(-15, 15, 2)])
        poses.append(Pose(rng.normal(size=3) * 0.1, np.eye(3), angles))
    return poses


def measured(
    body: Body, pose: Pose, count: int, noise: float, rng: np.random.Generator, *, side: np.ndarray | None = None
) -> FramePoints:
    """Points of the surface of thorax and right arm, with noise; of one side only where a direction is given."""
    names = body.skeleton.segment_names
    wanted = [k for k, name in enumerate(names) if name in ("thorax", "right_upperarm", "right_forearm", "right_hand")]
    strongest = body.vertex_segments[np.arange(len(body.vertices)), body.vertex_weights.argmax(1)]
    faces = body.faces[np.isin(strongest[body.faces], wanted).all(1)]
    posed = PosedBody(body, pose)
    corners = posed.vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    which = rng.choice(len(faces), 3 * count, p=area / area.sum())
    points = np.einsum("nc,nca->na", rng.dirichlet([1.0, 1.0, 1.0], len(which)), corners[which])
    surface = PosedMetaballs(body.metaballs.balls(body.numbers), pose)
    limb = vertex_limbs(body)[faces[which, 0]]
    points = surface.skin(points, limb)
    _, outward = surface.nearest_limbs(points)
    on = np.abs(surface.distance(points)) < 1e-5
    if side is not None:
        on &= outward @ side > 0.2
    points = points[on][:count]
    covariance = np.broadcast_to(noise**2 * np.eye(3), (len(points), 3, 3))
    return FramePoints(points + rng.normal(size=points.shape) * noise, covariance)
