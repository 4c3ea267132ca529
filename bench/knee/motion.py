"""A scanned knee moved by real skin markers, beside the same knee moved by the true bones; and how fast nearness is.

    python bench/knee_motion.py SHARED [trials|surfaces|speed] [--trials NAME ...] [--knee DIR] [--keep DIR]

SHARED holds `data/knee/phantom_a` and `template_a` and `data/markers/sta`. `trials`: femur, tibia and their cartilage
(surfaces from the true labels) are laid into the frame of each trial with the straightest knee as they lay in the
scanner, the middle of the condyles at the trial's own functional centre of the knee; for a left leg the knee is
mirrored. The true bones carry them. A standing trial is made of that frame: the trial's markers and the simulated
gadolinium balls, each coordinate with an error of 0.5 mm; the balls in the scanner have one of 0.2 mm, and their
names in markers.json. `marey markers` runs with the default method and with the rigid fit, `marey knee animate` with
both, and once more with the true bones, where the balls alone err. Printed are the errors of the gap in each
compartment against the true bones' (mm: mean, RMS, greatest), the share of true gaps within 1.96 stated deviations,
the RMS error of the centre of proximity over the tibia, and of the knee's angles. The bones are one person's and the
motion is another's: the gaps themselves mean nothing. `speed`: seconds of process time for 100 frames beside
trimesh's and SciPy's searches. The row "standard deviations alone" is of the default method with what turn and place of
a bone have in common left out. Data: Cereatti et al. 2017, J Biomech, doi 10.1016/j.jbiomech.2017.02.004.
"""

import argparse
import json
import shutil
import tempfile
import time
from pathlib import Path

import ezc3d
import numpy as np
from scipy.spatial import cKDTree
from true_bones import true_bones

from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.io.markers.bones import BoneFile, write_bones
from marey.io.markers.c3d import write_c3d
from marey.io.mr.meshes import read_mesh, write_mesh
from marey.io.mr.volumes import read_template
from marey.io.npz import read_arrays, write_arrays
from marey.io.opensim.trc import PointPaths
from marey.knee.bones.surfacing import surface_of_labels
from marey.knee.markers.anatomical_frames import bone_frame
from marey.knee.motion.joint_motion import KneeMotion, joint_proximities, joint_sides, knee_angles, motion_of_chains
from marey.knee.motion.joint_surface import JointSurface, joint_surface
from marey.knee.motion.proximity import RelativePoses, proximity
from marey.knee.space.sides import MIRROR, mirrored
from marey.knee.space.structures import BONE_OF_CARTILAGE, LABELS
from marey.knee.space.surface import Surface
from marey.markers.kinematics.transform_chain import (
    CAPTURE_ANATOMIC,
    CAPTURE_BONE,
    CAPTURE_DEFORMED,
    CAPTURE_GLOBAL,
    MR_ANATOMIC,
    MR_GLOBAL,
    NamedTransform,
    TransformChain,
    identity,
)
from marey.pipelines.knee.animate import AnimateOptions, animate
from marey.pipelines.markers.markers import markers
from marey.pipelines.markers.settings import MarkersOptions
from marey.pipelines.progress import Progress

TRIALS = ("unibo_step_up", "ottawa_walking", "lmam_treadmill_walking")
SEGMENT = {"femur": "thigh", "tibia": "shank"}
ANATOMIC_FROM_LPS = np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])
STANDING, STANDING_SD_MM, BALL_SD_MM = 20, 0.5, 0.2


def knee_of(shared: Path, folder: Path, *, left: bool) -> tuple[dict[str, Surface], np.ndarray, list[str]]:
    """The knee's surfaces and the balls' centres, as a folder of `marey knee segment` without `markers.json`."""
    labels = read_template(shared / "data" / "knee" / "template_a")
    truth = json.loads((shared / "data" / "knee" / "phantom_a" / "truth.json").read_text(encoding="utf-8"))
    parts, balls = {}, np.array(truth["marker_centres_lps_mm"])
    for name in LABELS:
        surface = surface_of_labels(labels, name)
        parts[name] = mirrored(surface) if left else surface
        write_mesh(folder / f"{name}.ply", parts[name])
    return parts, balls @ (MIRROR[:3, :3] if left else np.eye(3)), truth["marker_segment"]


def straightest(truth: dict[str, np.ndarray]) -> int:
    """The frame in which the thigh's and the shank's long axes are most alike."""
    return int(np.argmax((truth["thigh_rotation"][:, :, 1] * truth["shank_rotation"][:, :, 1]).sum(1)))


def functional_centre(truth: dict[str, np.ndarray], places: np.ndarray, at: int) -> np.ndarray:
    """The point of the knee in a frame that moves least in both bones; along the hinge near the markers."""
    middle = np.nanmean(places[at], axis=0)
    rows, right = [], []
    for f in range(len(truth["thigh_rotation"])):
        rows.append(np.concatenate([truth["thigh_rotation"][f], -truth["shank_rotation"][f]], 1))
        right.append(truth["shank_origin"][f] - truth["thigh_origin"][f])
    near = [truth[f"{s}_rotation"][at].T @ (middle - truth[f"{s}_origin"][at]) for s in ("thigh", "shank")]
    rows.append(0.3 * np.eye(6))
    right.append(0.3 * np.concatenate(near))
    found = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    return np.asarray(truth["thigh_rotation"][at] @ found[:3] + truth["thigh_origin"][at])


def true_chains(
    truth: dict[str, np.ndarray], laid: RigidTransform, at: int, frames: dict[str, RigidTransform]
) -> dict[str, TransformChain]:
    """The scanner's bones on the true ones: laid into one frame, and carried."""
    chains = {}
    for bone, segment in SEGMENT.items():
        turn, place = truth[f"{segment}_rotation"], truth[f"{segment}_origin"]
        own = RigidTransform(turn[at], place[at]).inverse() @ laid @ frames[bone]
        back = frames[bone].inverse()
        chains[bone] = TransformChain(
            mr_anatomic_from_mr_global=NamedTransform(
                to=MR_ANATOMIC, from_=MR_GLOBAL, rotation=back.rotation, translation=back.translation
            ),
            capture_anatomic_from_mr_anatomic=NamedTransform(
                to=CAPTURE_ANATOMIC, from_=MR_ANATOMIC, rotation=own.rotation, translation=own.translation
            ),
            deformed_from_capture_anatomic=identity(CAPTURE_DEFORMED, CAPTURE_ANATOMIC),
            bone_from_deformed=identity(CAPTURE_BONE, CAPTURE_DEFORMED),
            capture_global_from_bone=NamedTransform(
                to=CAPTURE_GLOBAL, from_=CAPTURE_BONE, rotation=turn, translation=place
            ),
        )
    return chains


def trial(shared: Path, name: str, work: Path) -> None:
    rng = np.random.default_rng(1)
    sta = shared / "data" / "markers" / "sta"
    truth = dict(np.load(sta / f"{name}.npz"))
    left = str(truth["side"]) == "left"
    knee_folder = work / "knee"
    parts, balls, riding = knee_of(shared, knee_folder, left=left)
    c3d = ezc3d.c3d(str(sta / f"{name}.c3d"))
    labels = c3d["parameters"]["POINT"]["LABELS"]["value"]
    places = c3d["data"]["points"][:3].transpose(2, 1, 0)
    frames = {bone: bone_frame(bone, parts[bone], np.zeros((0, 3)), left=left).scanner_from_bone for bone in SEGMENT}
    at = straightest(truth)
    turn = truth["shank_rotation"][at] @ ANATOMIC_FROM_LPS
    laid = RigidTransform(turn, functional_centre(truth, places, at) - turn @ frames["femur"].translation)
    standing = np.concatenate([places[at], laid.apply(balls)])
    standing = standing + rng.normal(0, STANDING_SD_MM, standing.shape)
    write_c3d(
        work / "standing.c3d",
        PointPaths(
            names=(*labels, *(f"MR{n}" for n in range(len(balls)))), time=np.arange(STANDING) / 100.0, rate=100.0,
            points=np.repeat(standing[None], STANDING, 0) / 1e3,
        ),
    )  # fmt: skip
    found = balls + rng.normal(0, BALL_SD_MM, balls.shape)
    markers_json = {
        "marker_centres_lps_mm": found.tolist(), "marker_centres_sd_mm": np.full_like(found, BALL_SD_MM).tolist(),
        "marker_names": [f"MR{n}" for n in range(len(balls))], "marker_segment": riding,
    }  # fmt: skip
    (knee_folder / "markers.json").write_text(json.dumps(markers_json), encoding="utf-8")
    known = {"frame": at} | {
        f"{s}_{k}": truth[f"{s}_{k}"][at] for s in SEGMENT.values() for k in ("rotation", "origin")
    }
    np.savez(work / "reference.npz", **known)
    quiet = Progress(quiet=True)
    options = MarkersOptions(
        out=work / "motion",
        reference=work / "reference.npz",
        methods=("skin", "rigid"),
        side="left" if left else "right",
    )
    motion = markers(sta / f"{name}.c3d", options, quiet)
    out = animate(
        knee_folder, motion, AnimateOptions(reference=work / "standing.c3d", compare="rigid", out=work / "out"), quiet
    )
    chains = true_chains(truth, laid, at, frames)
    moved = motion_of_chains(chains, np.arange(len(places)) / float(truth["rate"]), left=left)
    sides, _ = joint_sides(parts, ["femur", "tibia"], left=left)
    true = KneeMotion(
        method="true", motion=moved, joints=joint_proximities(moved, sides), angles=knee_angles(moved)
    )  # fmt: skip
    got = dict(np.load(out / "knee_motion.npz"))
    compare(name, true, got)
    compare(name, true, got, prefix="compared_")
    known = animate(
        knee_folder, with_true_bones(motion, truth, at, work / "true"),
        AnimateOptions(reference=work / "standing.c3d", out=work / "out_true", views=("plateau",)), quiet,
    )  # fmt: skip
    compare(name, true, dict(np.load(known / "knee_motion.npz")), method="true bones")
    apart = animate(
        knee_folder, without_covariance(motion, work / "apart"),
        AnimateOptions(reference=work / "standing.c3d", out=work / "out_apart", views=("plateau",)), quiet,
    )  # fmt: skip
    compare(name, true, dict(np.load(apart / "knee_motion.npz")), method="skin, standard deviations alone")


def with_true_bones(motion: Path, truth: dict[str, np.ndarray], at: int, folder: Path) -> Path:
    """The same folder of `marey markers`, with the bones' true poses, known exactly."""
    folder.mkdir()
    for name in ("motion.c3d", "marker_motion.csv"):
        shutil.copy(motion / name, folder / name)
    segments = tuple(SEGMENT.values())
    bones = true_bones(truth, segments)
    time = np.arange(len(bones)) / float(truth["rate"])
    write_bones(folder / "bones.npz", BoneFile(motion=bones, time=time, reference_frames=np.array([at])))
    return folder


def without_covariance(motion: Path, folder: Path) -> Path:
    """The same folder of `marey markers`, its bones with their standard deviations alone."""
    shutil.copytree(motion, folder)
    kept = {key: each for key, each in read_arrays(motion / "bones.npz").items() if not key.endswith("_covariance")}
    write_arrays(folder / "bones.npz", kept)
    return folder


def compare(
    name: str, true: KneeMotion, got: dict[str, np.ndarray], *, prefix: str = "", method: str | None = None
) -> None:
    joint = true.joints[0]
    row: dict[str, object] = {"trial": name, "method": method or str(got[f"{prefix}method"])}
    for c, compartment in enumerate(joint.compartments):
        off = got[f"{prefix}tibiofemoral_gap_mm"][:, c] - joint.gap_mm[:, c]
        sd, true_gap = got[f"{prefix}tibiofemoral_gap_sd_mm"][:, c], joint.gap_mm[:, c]
        centre = got[f"{prefix}tibiofemoral_tibial_cartilage_centre_mm"][:, c] - joint.centre_mm[:, c]
        row[compartment] = {
            "mean": round(float(np.nanmean(off)), 2), "rms": rms(off), "most": round(float(np.nanmax(abs(off))), 2),
            "stated_sd": round(float(np.nanmedian(sd)), 2),
            "within": round(float((abs(off) <= 1.96 * sd)[np.isfinite(off)].mean()), 3),
            "centre_rms": rms(np.linalg.norm(centre, axis=1)),
            "true_gap": [round(float(end(true_gap)), 1) for end in (np.nanmin, np.nanmax)],
        }  # fmt: skip
    if true.angles is not None and f"{prefix}angles_deg" in got:
        off = got[f"{prefix}angles_deg"] - np.degrees(true.angles.angles)
        row["angles_rms_deg"] = [rms(column) for column in off.T]
    print(json.dumps(row), flush=True)


def rms(values: np.ndarray) -> float:
    return round(float(np.sqrt(np.nanmean(values**2))), 2)


def both_sides(parts: dict[str, Surface]) -> list[JointSurface]:
    return [
        joint_surface(name, parts[name], parts[BONE_OF_CARTILAGE[name]], left=False)
        for name in ("tibial_cartilage", "femoral_cartilage")
    ]


def surfaces(shared: Path, work: Path, knee: Path) -> None:
    """What the segmentation's errors do to the gap."""
    true = both_sides(knee_of(shared, work, left=False)[0])
    found = both_sides({name: read_mesh(knee / f"{name}.ply") for name in LABELS})
    middle = true[1].surface.vertices_mm.mean(0)
    degrees = np.arange(0, 61, 15)
    turns = rotations.exp(np.radians(degrees)[:, None] * np.array([1.0, 0, 0]))
    poses = RelativePoses(rotation=turns, translation_mm=middle - turns @ middle)
    wanted, got = (proximity("", *sides, poses) for sides in (true, found))
    print(
        json.dumps(
            {
                "degrees": degrees.tolist(),
                "gap_error_mm": (got.gap_mm - wanted.gap_mm).T.round(2).tolist(),
                "near_area_ratio": (got.near_mm2 / wanted.near_mm2).T.round(2).tolist(),
                "centre_error_mm": np.linalg.norm(got.centre_mm - wanted.centre_mm, axis=2).T.round(1).tolist(),
            }
        )
    )


def speed(shared: Path, work: Path) -> None:
    import trimesh

    parts, _, _ = knee_of(shared, work, left=False)
    base, moving = both_sides(parts)
    middle = parts["femoral_cartilage"].vertices_mm.mean(0)
    turns = rotations.exp(np.radians(np.linspace(0, 60, 100))[:, None] * np.array([1.0, 0, 0]))
    poses = RelativePoses(rotation=turns, translation_mm=middle - turns @ middle, covariance=np.zeros((100, 6, 6)))
    proximity("", base, moving, RelativePoses(rotation=turns[:1], translation_mm=poses.translation_mm[:1]))
    began = time.process_time()
    found = proximity("tibiofemoral", base, moving, poses)
    ours = time.process_time() - began
    began = time.process_time()
    mesh = trimesh.Trimesh(moving.surface.vertices_mm, moving.surface.faces, process=False)
    theirs = trimesh.proximity.closest_point(mesh, (base.surface.vertices_mm - poses.translation_mm[0]) @ turns[0])[1]
    peer = time.process_time() - began
    began = time.process_time()
    tree = cKDTree(moving.surface.vertices_mm)
    corners = tree.query((base.surface.vertices_mm - poses.translation_mm[0]) @ turns[0])[0]
    points = time.process_time() - began
    known = np.isfinite(found.base_distance_mm[0])
    print(
        json.dumps(
            {
                "vertices": [len(base.surface.vertices_mm), len(moving.surface.vertices_mm)],
                "seconds_100_frames_both_ways": round(ours, 2),
                "trimesh_seconds_one_frame_one_way": round(peer, 2),
                "most_difference_mm": float(np.abs(np.abs(found.base_distance_mm[0]) - theirs)[known].max()),
                "scipy_nearest_corner_seconds_one_frame_one_way": round(points, 3),
                "most_error_of_nearest_corners_mm": round(float((corners - theirs).max()), 2),
            }
        )
    )


def main() -> None:
    reader = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    reader.add_argument("shared", type=Path)
    reader.add_argument("part", nargs="?", choices=("trials", "surfaces", "speed"))
    reader.add_argument("--trials", nargs="+", choices=TRIALS, default=TRIALS)
    reader.add_argument("--knee", type=Path, help="a folder of `marey knee segment` of phantom_a")
    reader.add_argument("--keep", type=Path, help="folder in which everything stays")
    asked = reader.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = asked.keep or Path(scratch)
        if asked.part in (None, "trials"):
            for name in asked.trials:
                (folder / name).mkdir(parents=True, exist_ok=True)
                trial(asked.shared, name, folder / name)
        if asked.part in (None, "surfaces") and asked.knee is not None:
            surfaces(asked.shared, folder / "surfaces", asked.knee)
        if asked.part in (None, "speed"):
            speed(asked.shared, folder / "speed")


if __name__ == "__main__":
    main()
