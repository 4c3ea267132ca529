"""A scanned knee moved by real skin markers, beside the same knee moved by the true bones.

`trials`: femur, tibia and their cartilage of phantom_a (surfaces from the true labels) are placed into the frame of
each trial with the straightest knee as they lay in the scanner, the middle of the condyles at the trial's own
functional centre of the knee; for a left leg the knee is mirrored. The true bones carry them. A standing trial is
made of that frame: the trial's markers and the simulated gadolinium balls, each coordinate with an error of 0.5 mm;
the balls in the scanner have one of 0.2 mm. `marey markers` runs with the default method and with the rigid fit,
`marey knee animate` with both, and once more with the true bones, where the balls alone err. The row "standard
deviations alone" is of the default method without the correlation of a bone's turn and place. The bones are one
person's and the motion is another's: the gaps themselves mean nothing. `surfaces`: what the segmentation's own errors
do to the gap. `speed`: time for 100 frames beside trimesh's and SciPy's searches. Data: Cereatti et al. 2017, J
Biomech, doi 10.1016/j.jbiomech.2017.02.004.
"""

import argparse
import json
import shutil
import time
from pathlib import Path

import ezc3d
import numpy as np
from scipy.spatial import cKDTree

from bench.common.parts import add_parts, run_parts
from bench.declaration import Bench
from bench.knee.cartilage import segmented
from bench.knee.true_bones import true_bones
from bench.recording import Column, Run, Table
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.io.markers.bones import BoneFile, write_bones
from marey.io.markers.c3d import write_c3d
from marey.io.mr.meshes import read_mesh, write_mesh
from marey.io.mr.volumes import read_template
from marey.io.npz import read_arrays, write_arrays
from marey.io.opensim.trc import PointPaths
from marey.knee.markers.anatomical_frames import bone_frame
from marey.knee.motion.joint_motion import KneeMotion, joint_proximities, joint_sides, knee_angles, motion_of_chains
from marey.knee.motion.joint_surface import JointSurface, joint_surface
from marey.knee.motion.proximity import RelativePoses, proximity
from marey.knee.space.sides import MIRROR, mirrored
from marey.knee.space.structures import BONE_OF_CARTILAGE, LABELS
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.surfacing import surface_of_labels
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
from marey.pipelines.knee.animate import animate_knee
from marey.pipelines.markers.estimate import estimate_bones, open_markers
from marey.pipelines.progress import RecordingProgress

BENCH = Bench(
    measures="Gap, proximity and angles of a simulated knee moved by real skin markers, against the true bones.",
    sources=("src/marey/knee/motion", "src/marey/knee/markers", "src/marey/knee/space", "src/marey/markers"),
    minutes=6,
)
TRIALS = ("unibo_step_up", "ottawa_walking", "lmam_treadmill_walking")
SEGMENT = {"femur": "thigh", "tibia": "shank"}
ANATOMIC_FROM_LPS = np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])
STANDING, STANDING_SD_MM, BALL_SD_MM = 20, 0.5, 0.2


def knee_of(shared: Path, folder: Path, *, left: bool) -> tuple[dict[str, TriangleSurface], np.ndarray, list[str]]:
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
    truth: dict[str, np.ndarray], laboratory_from_scanner: RigidTransform, at: int, frames: dict[str, RigidTransform]
) -> dict[str, TransformChain]:
    """The scanner's bones on the true ones: placed into one frame, and carried along."""
    chains = {}
    for bone, segment in SEGMENT.items():
        turn, place = truth[f"{segment}_rotation"], truth[f"{segment}_origin"]
        own = RigidTransform(turn[at], place[at]).inverse() @ laboratory_from_scanner @ frames[bone]
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


def trial(table: Table, shared: Path, name: str, work: Path) -> None:
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
    laboratory_from_scanner = RigidTransform(
        turn, functional_centre(truth, places, at) - turn @ frames["femur"].translation
    )
    standing = np.concatenate([places[at], laboratory_from_scanner.apply(balls)])
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
    quiet = RecordingProgress()
    motion = work / "motion"
    walk = open_markers(
        sta / f"{name}.c3d", reference=work / "reference.npz", side="left" if left else "right", progress=quiet
    )  # fmt: skip
    estimate_bones(walk, ("skin", "rigid"), out=motion, progress=quiet)
    out, standing = work / "out", work / "standing.c3d"
    animate_knee(knee_folder, motion, reference=standing, compare="rigid", out=out, progress=quiet)
    chains = true_chains(truth, laboratory_from_scanner, at, frames)
    moved = motion_of_chains(chains, np.arange(len(places)) / float(truth["rate"]), left=left)
    sides, _ = joint_sides(parts, ["femur", "tibia"], left=left)
    true = KneeMotion(
        method="true", motion=moved, joints=joint_proximities(moved, sides), angles=knee_angles(moved)
    )  # fmt: skip
    got = dict(np.load(out / "knee_motion.npz"))
    compare(table, name, true, got)
    compare(table, name, true, got, prefix="compared_")
    true_motion = with_true_bones(motion, truth, at, work / "true")
    known = work / "out_true"
    animate_knee(knee_folder, true_motion, reference=standing, views=("plateau",), out=known, progress=quiet)
    compare(table, name, true, dict(np.load(known / "knee_motion.npz")), method="true bones")
    apart, without = work / "out_apart", without_covariance(motion, work / "apart")
    animate_knee(knee_folder, without, reference=standing, views=("plateau",), out=apart, progress=quiet)
    compare(table, name, true, dict(np.load(apart / "knee_motion.npz")), method="skin, standard deviations alone")


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
    table: Table,
    name: str,
    true: KneeMotion,
    got: dict[str, np.ndarray],
    *,
    prefix: str = "",
    method: str | None = None,
) -> None:
    """Append one row per compartment."""
    joint, angles = true.joints[0], None
    if true.angles is not None and f"{prefix}angles_deg" in got:
        off = got[f"{prefix}angles_deg"] - np.degrees(true.angles.angles)
        angles = ", ".join(f"{rms(column):.1f}" for column in off.T)
    for c, compartment in enumerate(joint.compartments):
        off = got[f"{prefix}tibiofemoral_gap_mm"][:, c] - joint.gap_mm[:, c]
        sd, true_gap = got[f"{prefix}tibiofemoral_gap_sd_mm"][:, c], joint.gap_mm[:, c]
        centre = got[f"{prefix}tibiofemoral_tibial_cartilage_centre_mm"][:, c] - joint.centre_mm[:, c]
        within = 100 * (abs(off) <= 1.96 * sd)[np.isfinite(off)].mean()
        true_range = f"{np.nanmin(true_gap):.1f} to {np.nanmax(true_gap):.1f}"
        table.row(
            (name, method or str(got[f"{prefix}method"]), compartment), np.nanmean(off), rms(off), np.nanmax(abs(off)),
            np.nanmedian(sd), within, rms(np.linalg.norm(centre, axis=1)), true_range, angles,
        )  # fmt: skip


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def both_sides(parts: dict[str, TriangleSurface]) -> list[JointSurface]:
    return [
        joint_surface(name, parts[name], parts[BONE_OF_CARTILAGE[name]], left=False)
        for name in ("tibial_cartilage", "femoral_cartilage")
    ]


def surfaces(run: Run) -> None:
    """What the segmentation's errors do to the gap."""
    shared, knee, work = run.shared, segmented(run, "phantom_a"), run.out / "motion" / "surfaces"
    true = both_sides(knee_of(shared, work, left=False)[0])
    found = both_sides({name: read_mesh(knee / f"{name}.ply") for name in LABELS})
    middle = true[1].surface.vertices_mm.mean(0)
    degrees = np.arange(0, 61, 15)
    turns = rotations.exp(np.radians(degrees)[:, None] * np.array([1.0, 0, 0]))
    poses = RelativePoses(rotation=turns, translation_mm=middle - turns @ middle)
    wanted, got = (proximity("", *sides, poses) for sides in (true, found))
    table = run.table(
        "Surfaces of `marey knee segment` beside the true ones, the knee turned about the condyles", "turned by [deg]",
        *(Column(f"{side}: {what}", unit, digits) for side in ("medial", "lateral") for what, unit, digits in
          (("gap", "mm", 1), ("area within 5 mm, found over true", "", 2), ("centre of proximity off", "mm", 1))),
    )  # fmt: skip
    centre = np.linalg.norm(got.centre_mm - wanted.centre_mm, axis=2)
    figures = np.stack([got.gap_mm - wanted.gap_mm, got.near_mm2 / wanted.near_mm2, centre], axis=-1)
    for angle, row in zip(degrees, figures, strict=True):
        table.row(str(angle), *row.ravel())


def speed(run: Run) -> None:
    """Time proximity beside other searches."""
    import trimesh

    parts, _, _ = knee_of(run.shared, run.out / "motion" / "speed", left=False)
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
    columns = (Column("time", "s", 3), Column("greatest difference of distances", "mm"))
    count = f"{len(base.surface.vertices_mm)} and {len(moving.surface.vertices_mm)} vertices"
    table = run.table(f"Distances between cartilages of {count}", "search", *columns)
    most = float(np.abs(np.abs(found.base_distance_mm[0]) - theirs)[known].max())
    table.row("marey, 100 frames, both ways, with gap, areas, centres and deviations", ours, None)
    table.row("trimesh, one frame, one way", peer, f"{most:.0e}")
    table.row("SciPy, nearest corner, one frame, one way", points, f"{(corners - theirs).max():.1f}")


def trials(run: Run) -> None:
    """Move the knee by real trials."""
    table = run.table(
        "A simulated knee moved by real trials", ("trial", "method", "compartment"), Column("gap off, mean", "mm", 2),
        Column("RMS", "mm", 2), Column("greatest", "mm", 1), Column("stated sd, median", "mm", 2),
        Column("true gap within the 95 % interval", "%", 0), Column("centre of proximity, RMS", "mm", 1),
        Column("true gap", "mm"), Column("knee's angles, RMS", "deg"),
        note="The errors are against the same knee moved by the true bones; the true gaps themselves mean nothing.",
    )  # fmt: skip
    for name in run.arguments.trials:
        folder = run.out / "motion" / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        trial(table, run.shared, name, folder)


PARTS = {"trials": trials, "surfaces": surfaces, "speed": speed}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_parts(parser, PARTS)
    parser.add_argument("--trials", nargs="+", choices=TRIALS, default=TRIALS)


def run(run: Run) -> None:
    """Run the parts."""
    run_parts(run, PARTS)
