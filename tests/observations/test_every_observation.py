"""Every kind of observation is in this catalogue, and its derivative is the change that it shows."""

import importlib
import pkgutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tests.people import any_points, any_pose, stick_person

import marey.observations
from marey.arrays import Floats
from marey.body.articulation.pose import PosedBody
from marey.body.metaballs.metaball_person import MetaballSpace
from marey.body.metaballs.metaballs import Metaballs
from marey.cameras.camera import Camera
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.observations.carried_points import CarriedPoints
from marey.observations.detected_joints import DetectedJoints
from marey.observations.joint_point import JointPoints
from marey.observations.metaball_points import PointsOnMetaballs, assign
from marey.observations.observation import Observation
from marey.observations.prior import Habit, JointLimits, NearPose, ShapePrior
from marey.observations.silhouette import SilhouettePlanes, SilhouetteRays
from marey.observations.surface_tracks import TrackedPatches

Make = Callable[[np.random.Generator, PosedBody], Observation]
POINTS = 7
STEP = 1e-6


def directions(rng: np.random.Generator) -> Floats:
    vectors = rng.normal(size=(POINTS, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def planes(rng: np.random.Generator, posed: PosedBody) -> Observation:
    return SilhouettePlanes(
        where=any_points(rng, posed.body, POINTS), normals=directions(rng), offsets=rng.normal(size=POINTS),
        pixels_per_metre=rng.uniform(100, 300, POINTS), sigma_px=2.0,
    )  # fmt: skip


def rays(rng: np.random.Generator, posed: PosedBody) -> Observation:
    along = directions(rng)
    return SilhouetteRays(
        where=any_points(rng, posed.body, POINTS), directions=along,
        moments=np.cross(rng.normal(size=(POINTS, 3)), along),
        pixels_per_metre=rng.uniform(100, 300, POINTS), sigma_px=2.0,
    )  # fmt: skip


def near_pose(rng: np.random.Generator, posed: PosedBody) -> Observation:
    spread = rng.uniform(0.1, 1.0, len(posed.body.skeleton))
    spread[7] = np.inf
    return NearPose(pose=any_pose(rng, posed.body), spread=spread)


def any_camera(rng: np.random.Generator) -> Camera:
    away = RigidTransform.from_vector(rng.normal(size=3) * 0.2, np.array([0.0, 0.0, 9.0]))
    return Camera(
        name="cam", size=(640, 480), matrix=np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]),
        distortion=np.array([-0.1, 0.02, 0.001, 0.0]), camera_from_world=away,
    )  # fmt: skip


def joints(rng: np.random.Generator, posed: PosedBody) -> Observation:
    return JointPoints(
        camera=any_camera(rng), segments=np.array([3, 7, 8, 13]), pixels=rng.normal(size=(4, 2)) * 100, sigma_px=7.0
    )


def detected_joints(rng: np.random.Generator, posed: PosedBody) -> Observation:
    # With robust weights the derivative is that with the weights held: see test_detected_joints.py.
    return DetectedJoints(
        camera=any_camera(rng), segments=np.array([3, 7, 8, 13]), offsets=rng.normal(size=(4, 3)) * 0.05,
        pixels=rng.normal(size=(4, 2)) * 100, sd_px=rng.uniform(2, 9, 4), freedom=np.inf,
    )  # fmt: skip


def tracked_patches(rng: np.random.Generator, posed: PosedBody) -> Observation:
    root = rng.normal(size=(POINTS, 2, 2))
    return TrackedPatches(
        camera=any_camera(rng), tracks=np.arange(POINTS), where=any_points(rng, posed.body, POINTS),
        segments=rng.integers(0, len(posed.segment_origin), POINTS), directions=rng.normal(size=(POINTS, 3, 3)),
        pixels=rng.normal(size=(POINTS, 2)) * 100, information=root @ np.swapaxes(root, 1, 2),
    )  # fmt: skip


def points_on_metaballs(rng: np.random.Generator, posed: PosedBody) -> Observation:
    body, balls, numbers = posed.body, 40, len(posed.body.space)
    segments = rng.integers(0, len(body.skeleton.segment_names), balls)
    mean = Metaballs(
        skeleton=body.skeleton, joint_centres=body.space.joint_mean, segment=segments,
        centre=rng.normal(size=(balls, 3)) * 0.05, rotation=rotations.exp(rng.normal(size=(balls, 3))),
        radii=rng.uniform(0.1, 0.3, (balls, 3)), weight=np.ones(balls),
    )  # fmt: skip
    space = MetaballSpace(
        names=body.space.names, mean=mean, centre_modes=rng.normal(size=(numbers, balls, 3)) * 0.01,
        radii_modes=rng.normal(size=(numbers, balls, 3)) * 0.01, joint_modes=body.space.joint_modes,
        prior_covariance=np.eye(numbers),
    )  # fmt: skip
    near = posed.segment_origin[rng.integers(0, len(posed.segment_origin), POINTS)]
    points = near + rng.normal(size=(POINTS, 3)) * 0.1
    limb = assign(space, posed, points, np.zeros((POINTS, 3, 3)), model_sd=np.ones(POINTS)).limb
    return PointsOnMetaballs(space=space, points=points, limb=limb, spread=rng.uniform(0.5, 2.0, POINTS))


CATALOGUE: dict[type[Observation], Make] = {
    SilhouettePlanes: planes,
    SilhouetteRays: rays,
    JointPoints: joints,
    DetectedJoints: detected_joints,
    TrackedPatches: tracked_patches,
    JointLimits: lambda rng, posed: JointLimits(),
    Habit: lambda rng, posed: Habit(share=0.7),
    NearPose: near_pose,
    PointsOnMetaballs: points_on_metaballs,
    CarriedPoints: lambda rng, posed: CarriedPoints(
        segments=rng.integers(0, len(posed.segment_origin), POINTS),
        places=rng.normal(size=(POINTS, 3)) * 0.1,
        points=rng.normal(size=(POINTS, 3)),
        sigma_m=0.003,
    ),
    ShapePrior: lambda rng, posed: ShapePrior(share=0.5),
}
"""One line per kind: how to make one of any numbers."""


def every_kind() -> set[type[Observation]]:
    for module in pkgutil.walk_packages(marey.observations.__path__, "marey.observations."):
        importlib.import_module(module.name)
    found: set[type[Observation]] = set()
    waiting: list[type[Observation]] = [Observation]
    while waiting:
        kinds = waiting.pop().__subclasses__()
        waiting.extend(kinds)
        found.update(kind for kind in kinds if kind.__module__.startswith("marey."))
    return {kind for kind in found if not getattr(kind, "__abstractmethods__", None)}


def test_the_catalogue_is_complete():
    assert {kind.__name__ for kind in every_kind()} == {kind.__name__ for kind in CATALOGUE}


def test_all_kinds_are_final():
    assert all(getattr(kind, "__final__", False) for kind in every_kind())


def test_the_documentation_lists_every_kind():
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "add-an-observation.md").read_text(encoding="utf-8")
    assert [kind.__name__ for kind in CATALOGUE if f"| `{kind.__name__}` |" not in page] == []


@pytest.mark.parametrize("shape", [False, True], ids=["pose", "pose and shape"])
@pytest.mark.parametrize("kind", CATALOGUE, ids=lambda kind: kind.__name__)
def test_the_derivative_is_the_change(kind: type[Observation], shape: bool, rng: np.random.Generator):
    body = stick_person(rng)
    # Wide poses, so that some joints are beyond their limits.
    posed = PosedBody(body, any_pose(rng, body, spread=1.2))
    observation = CATALOGUE[kind](rng, posed)
    model = observation.linearize(posed, shape=shape)
    columns = len(body.skeleton) + (len(body.space) if shape else 0)
    assert model.jacobian.shape == (len(model.residual), columns)
    for column in range(columns):
        change = np.zeros(columns)
        change[column] = STEP
        ahead = observation.linearize(posed.moved(change), shape=shape).residual
        behind = observation.linearize(posed.moved(-change), shape=shape).residual
        difference = (ahead - behind) / (2 * STEP)
        # Central differences err by the step squared and by rounding over the step.
        tolerance = 1e-6 * max(1.0, np.abs(model.jacobian).max())
        np.testing.assert_allclose(model.jacobian[:, column], difference, atol=tolerance, err_msg=f"column {column}")


@pytest.mark.parametrize("kind", CATALOGUE, ids=lambda kind: kind.__name__)
def test_whitening_divides_by_sigma(kind: type[Observation], rng: np.random.Generator):
    body = stick_person(rng)
    posed = PosedBody(body, any_pose(rng, body))
    observation = CATALOGUE[kind](rng, posed)
    raw, white = observation.linearize(posed), observation.whiten(posed)
    assert observation.sigma > 0
    np.testing.assert_allclose(white.residual * observation.sigma, raw.residual)
    np.testing.assert_allclose(white.jacobian * observation.sigma, raw.jacobian)
