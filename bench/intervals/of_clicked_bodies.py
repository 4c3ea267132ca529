"""Sizes of made people whose skin deviates from metaballs, from clicked joints and points of one frame.

*Start*: the first fit alone. *Refined*: after all stages of `marey shape` that follow it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from bench.common.made_room import ring
from bench.intervals.scoring import Sample, single
from bench.recording import Run
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.body.metaballs.metaball_person import required_metaballs, vertex_limbs
from marey.body.metaballs.metaballs import PosedMetaballs
from marey.body.people.person import person_body
from marey.fit.points.levenberg import fit_points
from marey.fit.points.shape import (
    DETAILS_IN_TURN,
    ShapeEstimate,
    ShapeSettings,
    SurfaceMeasurements,
    final_covariances,
    metaballs_like,
    more_detailed,
    refine_shape,
    with_free_trunk,
)
from marey.fit.points.surface_points import FramePoints, PersonPoints
from marey.fit.recipes.start_joints import CLICKED_SD_M, clicked_joints
from marey.fit.search.levels import FrameLevels
from marey.observations.observation import Observation

SEEDS = range(40, 46)
COUNTS = (1000, 200)
"""Numbers of points."""
SIDES = {"one side": np.array([0.0, -1.0, 0.0]), "all round": None}
"""Directions from which the points are seen."""
POINT_SD_M = 3e-4
"""Noise of a point, per axis [m]."""
SKIN_SD_M, SKIN_REACH_M = 0.0024, 0.035
"""Deviation of the skin from metaballs [m], and the distance at which its correlation has decreased to 1/e, about as
the residuals of `arm3`."""
START_SD_M, START_SD_RAD = 0.02, 0.05
"""Error of the approximate pose, per coordinate [m, rad]."""
CAMERAS = 3
RATE_HZ = 30.0
SEGMENTS = ("thorax", "right_clavicle", "right_upperarm", "right_forearm", "right_hand")
"""Segments that have points."""
CLICKED = {"right_shoulder": "right_upperarm", "right_elbow": "right_forearm", "right_wrist": "right_hand"}
"""Clicked joints, with the segments that begin there."""


@dataclass(frozen=True, eq=False)
class Skin:
    """A random field over the skin, whose correlation decreases exponentially (random Fourier features)."""

    frequency: np.ndarray
    phase: np.ndarray

    @staticmethod
    def drawn(rng: np.random.Generator, count: int = 400) -> "Skin":
        """Draw a field; its frequencies have a Cauchy distribution."""
        frequency = rng.normal(size=(count, 3)) / np.abs(rng.normal(size=(count, 1))) / SKIN_REACH_M
        return Skin(frequency, rng.uniform(0.0, 2.0 * np.pi, count))

    def at(self, points: np.ndarray) -> np.ndarray:
        """Return the deviations (n,) of points (n, 3) along the normal [m]."""
        waves = np.cos(points @ self.frequency.T + self.phase).sum(1)
        return SKIN_SD_M * np.sqrt(2.0 / len(self.phase)) * waves


def samples(run: Run) -> Iterator[Sample]:
    """Fit the sizes of all people, as `marey shape --start` does in the clicked frame."""
    whole = with_free_trunk(person_body("fine", preset="right_arm"))
    for count in COUNTS:
        for what, side in SIDES.items():
            for seed in SEEDS:
                yield from of_person(whole, seed, count, what, side)


def of_person(whole: Body, seed: int, count: int, what: str, side: np.ndarray | None) -> Iterator[Sample]:
    """Fit one person, and compare the sizes in standard deviations among people."""
    rng, generic = np.random.default_rng(seed), metaballs_like(whole)
    truth = person(generic, rng)
    pose = usual_pose(truth, rng)
    points = measured(truth, pose, count, side, rng)
    off = np.append(rng.normal(size=3) * START_SD_M, rng.normal(size=len(truth.skeleton) - 3) * START_SD_RAD)
    given = PersonPoints(by_frame={0: points}, scale_m=ShapeSettings().first_scale_m)
    joints = clicks(whole, PosedBody(truth, pose), rng)
    start = fit_points(given, generic, {0: pose.step(off)}, others=joints)
    end = refined(start.body, start.poses, SurfaceMeasurements(PersonPoints(by_frame={0: points}), None, {0: joints}))
    unit, own = np.sqrt(np.diag(required_metaballs(generic).prior_covariance)), slice(len(truth.numbers))
    for stage, numbers, covariance in (
        ("start", start.body.numbers, start.covariance), ("refined", end.numbers, end.numbers_covariance),
    ):  # fmt: skip
        error, sd = (numbers[own] - truth.numbers) / unit, np.sqrt(np.diag(covariance)[own]) / unit
        yield single(f"sizes, clicked joints and {count} points {what}, {stage}", f"seed {seed}", "1", error, sd)


def refined(body: Body, poses: dict[int, Pose], given: SurfaceMeasurements) -> Body:
    """Refine a shape in one frame without silhouettes, as `marey shape` does after its start."""
    settings, cameras = ShapeSettings(), list(ring(CAMERAS, (640, 480)))
    levels = FrameLevels(cameras, lambda frame: [np.zeros((480, 640), bool)] * CAMERAS, 1.0)
    found = ShapeEstimate(body, poses, settings.begin_model_sd_m, settings.sequence.sigma_px)
    scale = settings.begin_scale_m
    for detail in DETAILS_IN_TURN[1:]:
        now = replace(found, body=more_detailed(found.body, detail, settings))
        found = refine_shape(
            now, levels, given, rate=RATE_HZ, repeats=settings.repeats, settings=settings, scale_m=scale
        )
        scale = np.inf
    weighed = given.with_uncertainty(found)
    return list(final_covariances(found, levels, weighed, rate=RATE_HZ, settings=settings))[-1].body


def person(generic: Body, rng: np.random.Generator) -> Body:
    """Draw a person from the prior; one whose metaballs have no size is drawn again."""
    space = required_metaballs(generic)
    while True:
        numbers = space.prior_mean + np.linalg.cholesky(space.prior_covariance) @ rng.normal(size=len(space))
        if space.is_possible(numbers):
            return generic.with_numbers(numbers)


def usual_pose(body: Body, rng: np.random.Generator) -> Pose:
    """Draw a usual pose within the joints' limits."""
    (mean, sd), (low, high) = body.skeleton.habit, body.skeleton.limits.T
    return Pose(np.zeros(3), np.eye(3), np.clip(mean + sd * rng.normal(size=len(mean)), low, high))


def measured(body: Body, pose: Pose, count: int, side: np.ndarray | None, rng: np.random.Generator) -> FramePoints:
    """Measure points of the skin, which deviates from the metaballs."""
    strongest = body.vertex_segments[np.arange(len(body.vertices)), body.vertex_weights.argmax(1)]
    wanted = [body.skeleton.segment(name) for name in SEGMENTS]
    faces = body.faces[np.isin(strongest[body.faces], wanted).all(1)]
    corners = PosedBody(body, pose).vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    which = rng.choice(len(faces), 6 * count, p=area / area.sum())
    points = np.einsum("nc,nca->na", rng.dirichlet([1.0, 1.0, 1.0], len(which)), corners[which])
    surface = PosedMetaballs(required_metaballs(body).balls(body.numbers), pose)
    points = surface.skin(points, vertex_limbs(body)[faces[which, 0]])
    outward = surface.nearest_limbs(points)[1]
    seen = np.abs(surface.distance(points)) < 1e-5
    if side is not None:
        seen &= outward @ side > 0.2
    points, outward = points[seen][:count], outward[seen][:count]
    points = points + outward * Skin.drawn(rng).at(points)[:, None]
    covariance = np.broadcast_to(POINT_SD_M**2 * np.eye(3), (len(points), 3, 3))
    return FramePoints(points + rng.normal(size=points.shape) * POINT_SD_M, covariance)


def clicks(whole: Body, truth: PosedBody, rng: np.random.Generator) -> list[Observation]:
    """Click the joints of the arm in all cameras."""
    cameras = list(ring(CAMERAS, (640, 480)))
    origin = truth.segment_origin[[whole.skeleton.segment(name) for name in CLICKED.values()]]
    pixels = np.stack([camera.project(origin) for camera in cameras])
    for own, camera in zip(pixels, cameras, strict=True):
        away = np.linalg.norm(truth.segment_origin.mean(0) - camera.centre)
        own += rng.normal(size=own.shape) * CLICKED_SD_M * camera.matrix[0, 0] / away
    return list(clicked_joints(cameras, tuple(CLICKED), pixels, truth))
