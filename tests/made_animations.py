"""What `marey knee animate` is given, made: a folder of a scanned knee, one of an activity, and a standing trial."""

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.geometry.rigid import RigidTransform
from marey.io.markers.bones import BoneFile, write_bones
from marey.io.markers.c3d import write_c3d
from marey.io.mr.meshes import write_mesh
from marey.io.opensim.trc import PointPaths
from marey.knee.space.surface import TriangleSurface
from marey.markers.data.bone_motion import BoneMotion
from tests.made_joints import RADIUS_MM, made_joint

GAP_MM = 1.0
RATE = 50.0
BALLS = {
    "femur": [[-48.0, -10, 60], [40, -25, 52], [-5, 42, 68], [36, 30, 42]],
    "tibia": [[-48.0, 12, -52], [46, -8, -58], [5, -40, -45], [-20, 35, -70]],
}
CLUSTERS = {
    "femur": [[-60.0, 10, 150], [-65, -20, 220], [-40, -50, 180], [10, -60, 200]],
    "tibia": [[-45.0, 5, -150], [-50, -20, -220], [-30, -40, -180], [10, -45, -250]],
}
SEGMENTS = {"femur": "thigh", "tibia": "shank"}


@dataclass(frozen=True, eq=False, kw_only=True)
class MadeActivity:
    """Where it lies, and the truth."""

    knee: Path
    motion: Path
    standing: Path
    laboratory_from_scanner: dict[str, list[RigidTransform]]
    """Frame of each bone by its name [mm]."""
    flexion_deg: Floats
    """(F,)."""


def flexed(degrees: float) -> RigidTransform:
    """The femur turned over the tibia about the axis through both condyles' middles [mm]: the gap stays as it is."""
    turn = RigidTransform.from_vector(np.radians(-degrees) * np.array([1.0, 0, 0]), np.zeros(3))
    middle = np.array([0.0, 0, RADIUS_MM + GAP_MM])
    return RigidTransform(turn.rotation, middle - turn.rotation @ middle)


def made_activity(
    folder: Path, *, left: bool = False, frames: int = 6, lost: tuple[int, ...] = (), sided: bool = False, fine: int = 3
) -> MadeActivity:
    """Make a knee that bends to 50 degrees in the room, exactly known; in lost frames the thigh has no pose."""
    rng = np.random.default_rng(5)
    degrees = np.linspace(0.0, 50.0, frames)
    about = RigidTransform.from_vector([0.1, -0.2, 1.1], [300.0, -200, 500])
    truth = {"tibia": [about @ RigidTransform(np.eye(3), [4.0 * f, 0, 0]) for f in range(frames)]}
    truth["femur"] = [at @ flexed(angle) for at, angle in zip(truth["tibia"], degrees, strict=True)]
    truth = {bone: truth[bone] for bone in BALLS}
    own = {bone: RigidTransform.from_vector(rng.normal(size=3), rng.normal(0, 50, 3)) for bone in BALLS}
    prefix = ("left_" if left else "right_") if sided else ""
    names = {bone: prefix + segment for bone, segment in SEGMENTS.items()}
    labels = {bone: [f"{names[bone]}_{n}" for n in range(len(CLUSTERS[bone]))] for bone in BALLS}
    _write_knee(folder / "knee", made_joint(left=left, gap_mm=GAP_MM, fine=fine))
    _write_motion(folder / "motion", truth, own, names, labels, lost)
    stood = [truth[bone][0].apply(np.array(CLUSTERS[bone])) for bone in BALLS]
    stood += [truth[bone][0].apply(np.array(BALLS[bone])) for bone in BALLS]
    every = [label for bone in BALLS for label in labels[bone]] + [
        f"MR{n}" for n in range(sum(map(len, BALLS.values())))
    ]
    _write_points(folder / "standing.c3d", every, np.repeat(np.concatenate(stood)[None], 5, 0))
    return MadeActivity(
        knee=folder / "knee", motion=folder / "motion", standing=folder / "standing.c3d",
        laboratory_from_scanner=truth, flexion_deg=degrees,
    )  # fmt: skip


def _write_knee(folder: Path, parts: dict[str, TriangleSurface]) -> None:
    for name, part in parts.items():
        write_mesh(folder / f"{name}.ply", part)
    centres = np.concatenate([BALLS[bone] for bone in BALLS])
    table = {
        "marker_centres_lps_mm": centres.tolist(), "marker_centres_sd_mm": np.full_like(centres, 0.1).tolist(),
        "marker_names": [f"MR{n}" for n in range(len(centres))],
        "marker_segment": [bone for bone in BALLS for _ in BALLS[bone]],
    }  # fmt: skip
    (folder / "markers.json").write_text(json.dumps(table), encoding="utf-8")


def _write_motion(
    folder: Path, truth: dict[str, list[RigidTransform]], own: dict[str, RigidTransform], names: dict[str, str],
    labels: dict[str, list[str]], lost: tuple[int, ...],
) -> None:  # fmt: skip
    """Write what `marey markers` leaves: the method `exact`, and beside it `rigid`, 3 mm off in the thigh."""
    folder.mkdir(parents=True)
    frames = len(truth["femur"])
    poses = {bone: [at @ own[bone] for at in truth[bone]] for bone in truth}
    rotation = np.stack([[at.rotation for at in poses[bone]] for bone in truth], 1)
    origin = np.stack([[at.translation for at in poses[bone]] for bone in truth], 1) / 1e3
    rotation[list(lost), 0], origin[list(lost), 0] = np.nan, np.nan
    spread = np.diag([0.005**2] * 3 + [0.0005**2] * 3)
    for name, shift in (("bones.npz", 0.0), ("bones_rigid.npz", 0.003)):
        up = np.stack([at.rotation[:, 2] for at in truth["tibia"]])
        moved = origin.copy()
        moved[1:, 0] += shift * up[1:]
        motion = BoneMotion(
            segments=tuple(names.values()), rotation=rotation, origin=moved,
            covariance=np.broadcast_to(spread, (frames, 2, 6, 6)),
        )  # fmt: skip
        write_bones(
            folder / name, BoneFile(motion=motion, time=np.arange(frames) / RATE, reference_frames=np.array([0]))
        )  # fmt: skip
    points = np.array(
        [np.concatenate([truth[b][f].apply(np.array(CLUSTERS[b])) for b in truth]) for f in range(frames)]
    )
    _write_points(folder / "motion.c3d", [label for bone in truth for label in labels[bone]], points)
    head = [f"{names[bone]}:{label}_{axis}_mm" for bone in truth for label in labels[bone] for axis in "xyz"]
    with (folder / "marker_motion.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerow(["time_s", *head])
    record = {"command": "markers", "settings": {"methods": ["exact", "rigid"]}, "inputs": {"trial.c3d": ""}}
    (folder / "run.json").write_text(json.dumps(record), encoding="utf-8")


def _write_points(path: Path, labels: list[str], points_mm: Floats) -> None:
    time = np.arange(len(points_mm)) / RATE
    write_c3d(path, PointPaths(names=tuple(labels), time=time, rate=RATE, points=points_mm / 1e3))
