"""Random trials of a thigh and a shank with known bones and skin that moves over them, to judge methods on.

Sizes, ranks and ranges are drawn from the span of those measured on real legs with known bones (Cereatti et al. 2017,
J Biomech, doi 10.1016/j.jbiomech.2017.02.004); nothing here is shared with the assumptions of a method.
"""

from dataclasses import dataclass

import numpy as np

from marey.geometry import rotations
from marey.markers.data.clusters import AnatomicalCalibration, Cluster
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.trajectories import trajectories

Z = np.array([0.0, 0.0, 1.0])
RATES = (6.0, 30.0, 120.0, 200.0, 240.0)
NOISE_M = 3e-4


@dataclass(frozen=True, eq=False, kw_only=True)
class MadeTrial:
    """One trial with its truth."""

    bones: dict[str, tuple[np.ndarray, np.ndarray]]
    """Segment to rotation (F, 3, 3) and origin (F, 3) [m]."""
    points: dict[str, np.ndarray]
    """Segment to markers (F, M, 3) [m]."""
    rate: float
    flexion: np.ndarray
    """(F,) of the knee [rad]."""

    def problem(self, postures: int) -> MarkerProblem:
        """The trial with the bones known in the first frame, or also in the one farthest from it in flexion."""
        frames = [0, int(np.abs(self.flexion - self.flexion[0]).argmax())][:postures]
        labels = {name: tuple(f"{name}_{i:02d}" for i in range(p.shape[1])) for name, p in self.points.items()}
        poses = list(self.bones.values())
        return MarkerProblem(
            trajectories=trajectories(
                sum(labels.values(), ()), np.concatenate(list(self.points.values()), 1), self.rate
            ),
            clusters=tuple(Cluster(segment=name, labels=labels[name]) for name in self.points),
            calibration=AnatomicalCalibration(
                segments=tuple(self.bones), frames=np.array(frames),
                rotation=np.stack([r[frames] for r, _ in poses], 1), origin=np.stack([o[frames] for _, o in poses], 1),
            ),
            joints=(("thigh", "shank"),),
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Kind:
    """What sort of trial: as much as is measured of one."""

    frames: int
    rate: float
    markers: tuple[int, int]
    """On thigh and shank."""
    skin_mm: tuple[float, float]
    """Root mean square motion of a marker over thigh and shank."""
    ranges_deg: tuple[float, float, float]
    """Of the knee's flexion, adduction and rotation."""


KINDS = {
    "slow bend of the knee": Kind(frames=133, rate=12, markers=(12, 4), skin_mm=(6.6, 1.3), ranges_deg=(102, 6, 8)),
    "run": Kind(frames=115, rate=200, markers=(5, 6), skin_mm=(7.3, 5.2), ranges_deg=(23, 4, 9)),
    "sidestep": Kind(frames=66, rate=120, markers=(4, 4), skin_mm=(7.4, 2.4), ranges_deg=(44, 11, 9)),
    "hop": Kind(frames=125, rate=40, markers=(4, 4), skin_mm=(4.2, 1.6), ranges_deg=(34, 6, 10)),
    "walk": Kind(frames=63, rate=30, markers=(6, 4), skin_mm=(8.1, 2.5), ranges_deg=(60, 5, 10)),
    "deep bend of the knee": Kind(frames=120, rate=30, markers=(6, 4), skin_mm=(11.4, 6.3), ranges_deg=(119, 5, 24)),
    "rise from a chair": Kind(frames=18, rate=6, markers=(19, 10), skin_mm=(25.6, 7.9), ranges_deg=(70, 4, 7)),
    "bend against gravity": Kind(frames=15, rate=6, markers=(19, 10), skin_mm=(9.0, 11.9), ranges_deg=(70, 4, 7)),
}
"""Sorts of trials with sizes as in the collection, frames thinned."""


def any_kind(rng: np.random.Generator) -> Kind:
    """Draw a sort: 13 to 400 frames, 4 to 30 markers a segment."""
    rate = float(rng.choice(RATES))
    counts = rng.choice([4, 4, 5, 6, 8, 12, 19, 30], 2)
    ranges = (rng.uniform(20, 110), rng.uniform(3, 11), rng.uniform(5, 12))
    return Kind(
        frames=int(rng.integers(13, 20)) if rate < 10 else int(rng.integers(60, 400)), rate=rate,
        markers=(int(counts[0]), int(counts[1])), skin_mm=(rng.uniform(6, 16), rng.uniform(2, 8)), ranges_deg=ranges,
    )  # fmt: skip


def made_trial(rng: np.random.Generator, kind: Kind | None = None) -> MadeTrial:
    """Draw one trial of a sort, or of any."""
    kind = kind or any_kind(rng)
    time = np.arange(kind.frames) / kind.rate
    flexion = _flexion(rng, time, np.radians(kind.ranges_deg[0]))
    bones = _bones(rng, time, flexion, np.radians(kind.ranges_deg[1:]))
    hip = rotations.log(bones["thigh"][0][0].T @ bones["thigh"][0])[:, 2]
    points = {}
    for name, count, size in zip(("thigh", "shank"), kind.markers, kind.skin_mm, strict=True):
        places = _places(rng, name, bones, count)
        drivers = _drivers(rng, time, flexion, hip)
        moved = _skin(rng, places, drivers, size / 1000)
        rotation, origin = bones[name]
        points[name] = np.einsum("fij,fmj->fmi", rotation, places + moved) + origin[:, None]
        points[name] = points[name] + rng.normal(0, NOISE_M, points[name].shape)
    return MadeTrial(bones=bones, points=points, rate=kind.rate, flexion=flexion)


def _smooth(rng: np.random.Generator, time: np.ndarray, waves: int = 3) -> np.ndarray:
    """A smooth course of variance about 1: a few sines of one to three periods in the trial."""
    phase = 2 * np.pi * time / max(time[-1], 1e-9)
    return (
        sum(rng.normal() * np.sin(phase * rng.uniform(0.5, 3) + rng.uniform(0, 6.3)) for _ in range(waves))
        * (2 / waves) ** 0.5
    )


def _flexion(rng: np.random.Generator, time: np.ndarray, ranged: float) -> np.ndarray:
    """Knee flexion (negative in these axes): one sweep or some cycles."""
    turns = rng.choice([0.5, 1.0, 2.0, 3.0])
    course = 0.5 - 0.5 * np.cos(2 * np.pi * turns * time / max(time[-1], 1e-9) + rng.uniform(0, 6.3))
    return -np.radians(rng.uniform(0, 20)) - ranged * course / np.ptp(course)


def _bones(rng: np.random.Generator, time: np.ndarray, flexion: np.ndarray, ranges: np.ndarray) -> dict:
    ranged = flexion / max(np.ptp(flexion), 1e-9)
    adduction = ranges[0] * _mixed(rng, ranged, _smooth(rng, time))
    rotation = ranges[1] * _mixed(rng, ranged, _smooth(rng, time))
    swing = np.stack([0.05 * _smooth(rng, time), 0.1 * _smooth(rng, time), 0.35 * _smooth(rng, time)], -1)
    thigh = rotations.exp(swing) @ rotations.exp(rng.normal(0, 0.2, 3))
    hip = 0.2 * np.stack([_smooth(rng, time) for _ in range(3)], -1) * np.array([3, 0.3, 0.3])
    x = np.array([1.0, 0.0, 0.0])
    y = np.array([0.0, 1.0, 0.0])
    knee = rotations.about(Z, flexion) @ rotations.about(x, adduction) @ rotations.about(y, rotation)
    shank = thigh @ knee
    centre = rng.normal(0, 0.01, 3)
    slide = rng.uniform(0.0007, 0.002) * np.stack([_smooth(rng, time) for _ in range(3)], -1)
    to_knee = rng.normal(0, 0.01, 3) + rng.choice([0.0, 0.36]) * y
    meet = hip + np.einsum("fij,fj->fi", thigh, centre + slide)
    return {"thigh": (thigh, hip), "shank": (shank, meet - shank @ to_knee)}


def _mixed(rng: np.random.Generator, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """A course of range 1 made of two."""
    share = rng.uniform(0, 1)
    course = share * rng.choice([-1, 1]) * first + (1 - share) * second / max(np.ptp(second), 1e-9)
    return course / max(np.ptp(course), 1e-9)


def _places(rng: np.random.Generator, name: str, bones: dict, count: int) -> np.ndarray:
    """Markers on a limb: all round it, or on the side and front only, along 10 to 35 cm."""
    length, middle = rng.uniform(0.1, 0.35), 0.2 if name == "thigh" else -0.17
    height = middle + length * (np.linspace(-0.5, 0.5, count) + rng.normal(0, 0.1, count))
    around = rng.uniform(1.5, 6.3)
    angle = rng.uniform(0, 6.3) + around * rng.permutation(np.linspace(0, 1, count))
    radius = (0.075 if name == "thigh" else 0.05) * rng.uniform(0.8, 1.2)
    places = np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], -1)
    if name == "thigh":
        return places
    rotation, origin = (part[0] for part in bones["shank"])
    # Heights count from the thigh's origin, wherever the shank's lies.
    return places + rotation.T @ (bones["thigh"][1][0] - origin)


def _drivers(rng: np.random.Generator, time: np.ndarray, flexion: np.ndarray, hip: np.ndarray) -> np.ndarray:
    """What skin follows (F, 5): the knee's turn, the hip's, a muscle, a wobble after an impact, something else."""
    impact = rng.uniform(0.1, 0.8) * time[-1]
    after = np.maximum(time - impact, 0)
    wobble = np.exp(-after / 0.08) * np.sin(2 * np.pi * rng.uniform(5, 15) * after)
    muscle = _smooth(rng, time)
    courses = np.stack([flexion, hip, muscle, wobble, _smooth(rng, time)], -1)
    courses = courses - courses[0]
    courses = courses / np.maximum(np.sqrt((courses**2).mean(0)), 1e-9)
    return courses * rng.dirichlet([4, 2, 2, 0.7, 1]) ** 0.5


def _skin(rng: np.random.Generator, places: np.ndarray, drivers: np.ndarray, size: float) -> np.ndarray:
    """Displacements (F, M, 3) of this root mean square: a common turn and shift, and fields of the markers' own."""
    about = places - places.mean(0)
    along = about / max(np.abs(about).max(), 1e-9)
    total = np.zeros((len(drivers), *places.shape))
    radius = np.sqrt((about[:, [0, 2]] ** 2).sum(1).mean())
    for driver in drivers.T:
        # The sleeve of skin turns about the limb more than it tilts.
        turn = rng.normal(0, [0.25, 0.8, 0.25]) / radius
        common = np.cross(turn, about) + rng.normal(0, 0.7, 3)
        field = along @ rng.normal(0, 0.7, (3, 3)) + rng.normal(0, 0.45, places.shape)
        own = rng.uniform(0.6, 1.6)
        total += driver[:, None, None] * (common + own * field)
    return total * size / np.sqrt((total**2).sum(-1).mean())
