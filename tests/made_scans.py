"""A made knee in the scanner and in the laboratory: bones, balls on the skin, a standing trial and an activity."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from marey.arrays import Floats
from marey.geometry.rigid import RigidTransform
from marey.knee.markers.marker_naming import ScannerMarkers
from marey.knee.markers.reference_posture import Activity
from marey.knee.space.surface import TriangleSurface
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.trajectories import MarkerTrajectories, trajectories
from tests.made_bones import made_bone

BALLS = {
    "femur": [[-45.0, -10, 30], [40, -25, 22], [-5, 42, 48], [30, 30, 12], [-30, -38, 55]],
    "tibia": [[-38.0, 12, -52], [42, -8, -68], [5, -40, -45], [-20, 35, -88], [28, 30, -110]],
}
CLUSTERS = {
    "femur": [[-60.0, 10, 150], [-65, -20, 220], [-40, -50, 180], [-50, 30, 260], [10, -60, 200]],
    "tibia": [[-45.0, 5, -150], [-50, -20, -220], [-30, -40, -180], [10, -45, -250], [-48, 12, -280]],
}
SEGMENTS = {"femur": "thigh", "tibia": "shank"}


@dataclass(frozen=True, eq=False, kw_only=True)
class MadeScan:
    """What a user has in hand, and the truth."""

    bones: dict[str, TriangleSurface]
    scanner: ScannerMarkers
    activity: Activity
    standing: MarkerTrajectories
    laboratory_from_scanner: dict[str, list[RigidTransform]]
    """By bone, a frame of the activity [mm]."""

    @property
    def ball_labels(self) -> list[str]:
        return [f"MR{n}" for n in range(sum(map(len, BALLS.values())))]


@lru_cache(maxsize=1)
def made_bones() -> dict[str, TriangleSurface]:
    femur = made_bone(fine=3)
    over = np.diag([1.0, -1.0, -1.0])
    tibia = TriangleSurface(vertices_mm=made_bone(fine=3, seed=1).vertices_mm @ over - [0, 0, 52.0], faces=femur.faces)
    return {"femur": femur, "tibia": tibia}


def bent(degrees: float) -> RigidTransform:
    """The tibia bent about the middle of the knee, in the scanner's frame [mm]."""
    turn = RigidTransform.from_vector(np.radians(degrees) * np.array([1.0, 0.1, 0.05]), np.zeros(3))
    middle = np.array([0.0, 0.0, -25.0])
    return RigidTransform(turn.rotation, middle - turn.rotation @ middle)


def postures(rng: np.random.Generator, degrees: list[float], *, sway: float = 1.0) -> dict[str, list[RigidTransform]]:
    """Where the scanner's frame lies in the laboratory with each bone [mm], a posture an angle."""
    about = RigidTransform.from_vector(rng.normal(0, 1.0, 3), rng.normal(0, 300, 3))
    femur = [
        about @ RigidTransform.from_vector(rng.normal(0, 0.5 * sway, 3), rng.normal(0, 300 * sway, 3)) for _ in degrees
    ]
    return {"femur": femur, "tibia": [at @ bent(angle) for at, angle in zip(femur, degrees, strict=True)]}


def made_scan(
    rng: np.random.Generator, *, noise_mm: float = 0.0, named: bool = True, balls_are_clusters: bool = False
) -> MadeScan:
    """Make a scan, a standing trial of 20 frames with one error a marker, and an activity of 6 frames without any."""
    in_bone = {bone: np.array(places) for bone, places in CLUSTERS.items()}
    balls = {bone: np.array(places) for bone, places in BALLS.items()}
    if balls_are_clusters:
        in_bone = balls
    frames = {bone: RigidTransform.from_vector(rng.normal(size=3), rng.normal(0, 50, 3)) for bone in balls}
    truth = postures(rng, [5.0, 10, 20, 40, 50, 30])
    standing = postures(rng, [8.0] * 20, sway=0.01)
    labels = {bone: [f"{SEGMENTS[bone]}_{n}" for n in range(len(in_bone[bone]))] for bone in balls}
    names = [f"MR{n}" for n in range(sum(map(len, balls.values())))]
    if balls_are_clusters:
        names = [label for bone in balls for label in labels[bone]]
    places = {"clusters": in_bone} if balls_are_clusters else {"clusters": in_bone, "balls": balls}
    every = [label for bone in balls for label in labels[bone]] + ([] if balls_are_clusters else names)
    stood = np.array([_seen(places, {bone: standing[bone][f] for bone in balls}) for f in range(20)])
    stood += rng.normal(0, noise_mm, stood.shape[1:])
    moved = np.array([_seen({"clusters": in_bone}, {bone: truth[bone][f] for bone in balls}) for f in range(6)])
    bones = {bone: [truth[bone][f] @ frames[bone] for f in range(6)] for bone in balls}
    motion = BoneMotion(
        segments=tuple(SEGMENTS[bone] for bone in balls),
        rotation=np.stack([[at.rotation for at in bones[bone]] for bone in balls], 1),
        origin=np.stack([[at.translation for at in bones[bone]] for bone in balls], 1) / 1e3,
        covariance=np.zeros((6, 2, 6, 6)),
    )
    riding = [label for bone in balls for label in labels[bone]]
    activity = Activity(
        motion=motion, markers=trajectories(riding, moved / 1e3, 100.0), reference_frames=np.array([0]),
        segment_of_label={label: SEGMENTS[bone] for bone in balls for label in labels[bone]},
        time=np.arange(6) / 100.0,
    )  # fmt: skip
    centres = np.concatenate(list(balls.values()))
    scanner = ScannerMarkers(
        centres_mm=centres + rng.normal(0, 0.2 * noise_mm, centres.shape),
        sd_mm=np.full(centres.shape, max(0.2 * noise_mm, 1e-3)), names=tuple(names) if named else (),
        bones=tuple(bone for bone in balls for _ in balls[bone]),
    )  # fmt: skip
    return MadeScan(
        bones=made_bones(), scanner=scanner, activity=activity, standing=trajectories(every, stood / 1e3, 100.0),
        laboratory_from_scanner=truth,
    )  # fmt: skip


def _seen(places: dict[str, dict[str, Floats]], at: dict[str, RigidTransform]) -> Floats:
    return np.concatenate([at[bone].apply(points) for kind in places.values() for bone, points in kind.items()])
