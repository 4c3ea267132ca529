"""Made sessions with a wand: true cameras around a wand that is waved about, tags on the floor, noisy pixels."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.calibration.boards.corners import BoardSighting, CornerSet
from marey.calibration.boards.wand import CalibrationWand, Landmark
from marey.cameras.rig import Rig
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from tests.made_boards import made_rig

WAND = CalibrationWand(distances=(0.2, 0.4), diameter=0.03)
TAGS = tuple(
    Landmark(name=f"tag {k}", place=place, sd=1e-3, tag=k)
    for k, place in enumerate([(-1.2, -1.0, 0.0), (1.3, -1.1, 0.0), (1.1, 1.2, 0.0), (-1.0, 1.0, 0.0)])
)


@dataclass(frozen=True, eq=False, kw_only=True)
class MadeWand:
    """True cameras and poses of a wand, and the centres of balls and tags that the cameras found."""

    rig: Rig
    poses: tuple[RigidTransform, ...]
    corners: CornerSet
    wand: CalibrationWand
    landmarks: tuple[Landmark, ...]
    seen: dict[tuple[int, str], np.ndarray]
    """Pixel of each landmark by camera and name."""


def waved(
    pictures: int, rng: np.random.Generator, wand: CalibrationWand, *, late: Sequence[float | np.ndarray] = (0.0,),
    pace: float = 1.0,
) -> list[list[RigidTransform]]:  # fmt: skip
    """Poses of a wand that is waved on a walk through 4 m x 4 m, as cameras show them that are late [pictures].

    At a pace of one, all pictures show the whole walk; at ten per second, 600 of them take a minute.
    """
    phase = rng.uniform(0, 2 * np.pi, 6)
    return [_waved_at(pace * (np.linspace(0, 1, pictures) - each / (pictures - 1)), phase, wand) for each in late]


def _waved_at(time: np.ndarray, phase: np.ndarray, wand: CalibrationWand) -> list[RigidTransform]:
    place = np.stack([1.7 * np.sin(9.1 * np.pi * time + phase[0]), 1.7 * np.sin(13.7 * np.pi * time + phase[1]),
                      1.1 + 0.8 * np.sin(43 * np.pi * time + phase[2])], -1)  # fmt: skip
    heading = 2 * np.pi * 21.3 * time + phase[3]
    slope = np.radians(60) * np.sin(57 * np.pi * time + phase[4])
    poses = []
    for k in range(len(time)):
        turn = rotations.about(np.array([0, 0, 1.0]), heading[k]) @ rotations.about(np.array([0, 1.0, 0]), slope[k])
        poses.append(RigidTransform(turn, place[k] - turn @ wand.centre))
    return poses


def made_wand(
    *, cameras: int = 4, pictures: int = 150, seed: int = 0, noise: float = 0.1, wand: CalibrationWand = WAND,
    landmarks: tuple[Landmark, ...] = TAGS, rig: Rig | None = None, late: Sequence[float | np.ndarray] | None = None,
    pace: float = 1.0,
) -> MadeWand:  # fmt: skip
    """A session with independent errors of a standard deviation [px], and exact coordinates of the tags.

    The cameras may be late by some pictures each, or by another number in each of their pictures; the poses are those
    of instants on time.
    """
    rng = np.random.default_rng(seed)
    rig = made_rig(cameras, rng) if rig is None else rig
    shown = waved(pictures, rng, wand, late=[0.0, *(late or [0.0] * len(rig))], pace=pace)
    spread = np.broadcast_to(np.eye(2) * max(noise, 1e-3) ** 2, (len(wand.points), 2, 2))
    rows = []
    for k in range(pictures):
        for c, camera in enumerate(rig):
            pixels = camera.project(shown[c + 1][k].apply(wand.points))
            if camera.sees(pixels, margin=4.0).all():
                found = pixels + rng.normal(0, noise, pixels.shape)
                rows.append((k, c, BoardSighting(corner=np.arange(len(pixels)), pixels=found, covariance=spread)))
    seen = {}
    for c, camera in enumerate(rig):
        for each in landmarks:
            pixel = camera.project(np.array([each.place]))
            if camera.sees(pixel, margin=4.0).all():
                seen[c, each.name] = pixel[0] + rng.normal(0, noise, 2)
    names = tuple(f"{k:04d}" for k in range(pictures))
    corners = CornerSet.gather(rig.names, tuple(camera.size for camera in rig), names, rows)
    return MadeWand(
        rig=rig, poses=tuple(shown[0]), corners=corners, wand=wand, landmarks=landmarks, seen=seen
    )  # fmt: skip
