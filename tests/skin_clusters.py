"""Made clusters of markers on moving bones, for the tests of the room."""

from itertools import pairwise

import numpy as np

from marey.arrays import Floats
from marey.geometry import rotations
from marey.markers.data.clusters import AnatomicalCalibration, Cluster
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.trajectories import trajectories

RATE = 100.0


def smooth_motion(rng: np.random.Generator, frames: int) -> tuple[Floats, Floats]:
    """A bone that swings and turns about all axes: rotation (F, 3, 3) and origin (F, 3) [m]."""
    phase = 2 * np.pi * np.arange(frames)[:, None] / frames + rng.uniform(0, 6, 3)
    rotation = rotations.exp(np.sin(phase) * rng.uniform(0.2, 0.6, 3)) @ rotations.exp(rng.normal(size=3))
    return rotation, 0.3 * np.cos(phase) + rng.normal(size=3)


def thigh(rng: np.random.Generator, markers: int) -> Floats:
    """Markers (M, 3) on a cone about the y axis, in the bone's frame [m]."""
    height = np.linspace(0.05, 0.35, markers)
    angle = 2.4 * np.arange(markers) + rng.uniform(0, 6)
    radius = 0.05 + 0.12 * height
    return np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], -1) + rng.normal(0, 0.004, (markers, 3))


def placed(rotation: Floats, origin: Floats, places: Floats) -> Floats:
    """The markers (F, M, 3) in the laboratory, from places (M, 3) or (F, M, 3) on the bone."""
    places = np.broadcast_to(places, (len(rotation), *places.shape[-2:]))
    return np.einsum("fij,fmj->fmi", rotation, places) + origin[:, None]


def problem(
    bones: dict[str, tuple[Floats, Floats]], points: dict[str, Floats], *, frames: list[int], noise_m: float = 5e-4
) -> MarkerProblem:
    """A trial of several bones with their true poses known in some frames."""
    labels = {name: [f"{name}_{i:02d}" for i in range(p.shape[1])] for name, p in points.items()}
    clusters = tuple(Cluster(segment=name, labels=tuple(labels[name])) for name in points)
    calibration = AnatomicalCalibration(
        segments=tuple(bones),
        frames=np.array(frames),
        rotation=np.stack([r[frames] for r, _ in bones.values()], 1),
        origin=np.stack([o[frames] for _, o in bones.values()], 1),
    )
    every = [label for name in points for label in labels[name]]
    names = list(bones)
    return MarkerProblem(
        trajectories=trajectories(every, np.concatenate(list(points.values()), 1), RATE), clusters=clusters,
        calibration=calibration, joints=tuple(pairwise(names)), noise_m=noise_m,
    )  # fmt: skip


def leg_bones(rng: np.random.Generator, frames: int) -> dict[str, tuple[Floats, Floats]]:
    """A thigh that moves freely and a shank that turns on it about one axis (z) through the thigh's origin."""
    rotation, origin = smooth_motion(rng, frames)
    flexion = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(frames) / frames)
    knee = rotations.about(np.array([0.0, 0.0, 1.0]), -flexion)
    return {"thigh": (rotation, origin), "shank": (rotation @ knee, origin)}


def rigid_leg(rng: np.random.Generator, *, frames: int = 40, known: list[int] | None = None) -> MarkerProblem:
    """A leg whose markers do not move over the bones, without noise."""
    return leg_and_bones(rng, frames=frames, known=known)[0]


def leg_and_bones(
    rng: np.random.Generator, *, frames: int = 40, known: list[int] | None = None
) -> tuple[MarkerProblem, dict[str, tuple[Floats, Floats]]]:
    """The same with the true poses of the bones."""
    bones = leg_bones(rng, frames)
    points = {"thigh": placed(*bones["thigh"], thigh(rng, 9)), "shank": placed(*bones["shank"], -thigh(rng, 7))}
    return problem(bones, points, frames=known or [0]), bones


def turns(first: Floats, second: Floats) -> Floats:
    """The angles (...) between rotations [rad]."""
    return np.linalg.norm(rotations.log(np.swapaxes(first, -1, -2) @ second), axis=-1)
