"""A made-up person for the tests of results: a body of boxes on the full skeleton, and a motion of it."""

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.skeleton import ROOT_AXES, full_skeleton
from marey.body.articulation.surface import Body, ShapeSpace
from marey.geometry import rotations
from marey.motion import anatomical
from marey.motion.motion import MEASURED, NO_PERSON, BodyMotion

ARM = np.array([0.67, -0.02, -0.74])
CENTRES = {
    "pelvis": (0, 0, 0.95), "abdomen": (0, 0.01, 1.05), "thorax": (0, 0.03, 1.2), "neck": (0, 0.03, 1.45),
    "head": (0, 0.0, 1.55), "left_clavicle": (0.03, 0, 1.4), "left_upperarm": (0.18, 0.02, 1.4),
    "left_thigh": (0.09, 0, 0.92), "left_shank": (0.12, -0.01, 0.5), "left_foot": (0.15, 0.02, 0.08),
    "left_toes": (0.17, -0.12, 0.02),
}  # fmt: skip


def body() -> Body:
    """Stand a person up whose every segment is a small box, half of it shared with the parent."""
    skeleton = full_skeleton(arm=ARM, elbow=np.array([-0.5, 0.7, -0.47]), palm=np.array([-0.6, -0.5, -0.5]))
    centres = {name: np.array(c, float) for name, c in CENTRES.items()}
    for segment, parent, length in (("forearm", "upperarm", 0.28), ("hand", "forearm", 0.25)):
        centres[f"left_{segment}"] = centres[f"left_{parent}"] + length * ARM / np.linalg.norm(ARM)
    centres |= {n.replace("left", "right"): c * [-1, 1, 1] for n, c in centres.items() if n.startswith("left")}
    joints = np.array([centres[name] for name in skeleton.segment_names])
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.04
    box = [(0, 1, 3), (0, 3, 2), (4, 7, 5), (4, 6, 7), (0, 5, 1), (0, 4, 5), (2, 3, 7), (2, 7, 6)]
    faces = np.array([*box, (0, 2, 6), (0, 6, 4), (1, 7, 3), (1, 5, 7)])
    count = len(joints)
    segments = np.zeros((8 * count, 4), int)
    weights = np.zeros((8 * count, 4))
    segments[:, 0] = np.repeat(np.arange(count), 8)
    segments[:, 1] = np.maximum(np.repeat(skeleton.parents, 8), 0)
    weights[:, 0], weights[:, 1] = np.tile([1, 0.6], 4 * count), np.tile([0, 0.4], 4 * count)
    vertices = (joints[:, None] + corners).reshape(-1, 3)
    space = ShapeSpace(
        names=(), vertex_mean=vertices, vertex_modes=np.zeros((0, *vertices.shape)), joint_mean=joints,
        joint_modes=np.zeros((0, *joints.shape)), prior_mean=np.zeros(0), prior_covariance=np.zeros((0, 0)),
    )  # fmt: skip
    return Body(
        skeleton=skeleton, space=space, numbers=np.zeros(0),
        faces=np.concatenate([faces + 8 * k for k in range(count)]), vertex_segments=segments, vertex_weights=weights,
    )  # fmt: skip


def coordinates(person: Body, frames: int, rng: np.random.Generator) -> Floats:
    """Move every coordinate smoothly and far, within its limits."""
    phase, cycles = rng.uniform(0, 2 * np.pi, (2, len(person.skeleton)))
    wave = np.sin(phase + cycles / 12 * np.arange(frames)[:, None])
    low, high = np.concatenate([np.array([(-1, 1), (-1, 1), (0.7, 1), (-3, 3), (-0.5, 0.5), (-0.5, 0.5)])]).T
    low, high = (np.concatenate([root, person.skeleton.limits[:, i]]) for i, root in enumerate((low, high)))
    return (low + high) / 2 + 0.45 * (high - low) * wave


def root_rotation(angles: Floats) -> Floats:
    """Return the root's rotation from its three angles: the inverse of `root_angles`."""
    angles = np.asarray(angles, float)
    turns = [rotations.about(np.array(axis), angles[..., i]) for i, axis in enumerate(ROOT_AXES)]
    return turns[0] @ turns[1] @ turns[2]


def pose(person: Body, q: Floats) -> PosedBody:
    """Pose a body by all its coordinates."""
    return PosedBody(person, Pose(q[:3], root_rotation(q[3:6]), q[6:]))


def motion(person: Body, frames: int = 24, gap: tuple[int, ...] = (0, 1, 11, 12)) -> BodyMotion:
    """Make a motion with gaps."""
    rng = np.random.default_rng(7)
    q = coordinates(person, frames, rng)
    posed = [pose(person, row) for row in q]
    rotation = np.stack([p.segment_rotation for p in posed])
    origin = np.stack([p.segment_origin for p in posed])
    anatomy = anatomical.anatomy_of(person.skeleton, person.joint_centres)
    angles = np.degrees(anatomical.anatomical_angles(anatomy, rotation))
    centres = origin[:, person.joint_segments]
    agreement = rng.uniform(0.8, 1, (frames, 2))
    holes = [q, rotation, origin, angles, centres, agreement]
    for array in holes:
        array[list(gap)] = np.nan
    state = np.full(frames, MEASURED)
    state[list(gap)] = NO_PERSON
    sure = np.isfinite(angles) & (rng.random(angles.shape) < 0.8)
    return BodyMotion(
        time=np.arange(frames) / 30.0, rate=30.0, joint_names=person.joint_names, joint_centres=centres,
        joint_centres_sd=0.01 + 0 * centres, segment_names=person.skeleton.segment_names, segment_rotation=rotation,
        segment_origin=origin, coordinate_names=person.skeleton.coordinate_names, coordinates=q,
        coordinates_sd=0.02 + 0 * q, determined=np.isfinite(q), angle_names=anatomy.angle_names, angles_deg=angles,
        angles_deg_sd=1 + 0 * angles, state=state, camera_names=("cam01", "cam02"), agreement=agreement,
        angles_determined=sure,
    )  # fmt: skip
