"""One small valid file for every reader of the package, and the call that reads it."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from marey.cameras.parameters import PARAMETER_NAMES
from marey.cameras.rig import Rig
from marey.geometry import rotations
from marey.io.calibration.board import board_content, board_of_content
from marey.io.calibration.camera_matrix import read_matrix
from marey.io.calibration.covariance import read_camera_covariance
from marey.io.calibration.target import read_target
from marey.io.gltf.character import read_character
from marey.io.gltf.rig import read_map, read_rig
from marey.io.gltf.rig_names import name_joints
from marey.io.markers.bones import BoneFile, read_bones, write_bones
from marey.io.markers.c3d_forces import read_events, read_force_plates
from marey.io.markers.readers import read_markers
from marey.io.markers.reading_results import read_joint_csv, read_marker_motion, read_static_landmarks
from marey.io.markers.recordings import read_recording
from marey.io.markers.setup import read_marker_setup, read_reference
from marey.io.mr import gadolinium
from marey.io.mr.contours import read_contours, write_contours
from marey.io.mr.meshes import read_mesh, write_mesh
from marey.io.mr.scanner_markers import read_landmarks, read_scanner_markers
from marey.io.mr.tables import read_parts
from marey.io.mr.volumes import read_labels, read_volume, write_labels, write_volume
from marey.io.npz import read_motion, write_arrays
from marey.io.opensim.mot_sto import read_orientations, read_table
from marey.io.opensim.osim_model import read_osim_model
from marey.io.opensim.osim_tasks import read_tasks
from marey.io.opensim.trc import read_trc
from marey.io.results.body import read_body
from marey.io.results.gait import read_cycle_bands, read_event_csv, read_gait_cycles_csv
from marey.io.results.repetitions import read_repetitions
from marey.io.results.results import write_results
from marey.io.shapes.deforming_points import read_deforming
from marey.io.shapes.measured_surface import read_surface, write_surface
from marey.io.shapes.shapes import read_shapes, write_shapes
from marey.io.shapes.tracks import read_points
from marey.io.shapes.trajectories import read_trajectories, write_trajectories
from marey.io.trial.clocks import read_clocks
from marey.io.trial.key_points import read_key_points
from marey.io.trial.masks import open_masks, write_masks
from marey.io.trial.seeds import read_seeds
from marey.io.trial.start_joints import read_start_joints
from marey.io.trial.trial import read_settings
from marey.io.video.video import read_picture
from marey.knee.outlines.contours import Contour
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.volume import Labels, Volume, VoxelGrid
from marey.markers.data.bone_motion import BoneMotion
from marey.motion.events.curves import CYCLE_POINTS
from marey.nonrigid.recovered import GAUGES, ONE_VIEW, RankCurve, RecoveredShapes
from marey.pipelines.same_names import read_name_map
from marey.surface.tracks.trajectories import Trajectories
from tests import performer, rigs, worlds
from tests.surfaces import some_points
from tests.trials import marker_points, write_reference, write_trial

RIG = Rig(worlds.ring(2))
GRID = VoxelGrid(shape=(6, 8, 10), lps_from_voxel=np.diag([-0.5, 0.5, 2.0, 1.0]))
TASKS = """<OpenSimDocument><IKTaskSet><objects>
<IKMarkerTask name="a"><apply>true</apply><weight>2.5</weight></IKMarkerTask>
<IKCoordinateTask name="q"><apply> true </apply><weight>10</weight>
<value_type>manual_value</value_type><value>0.5</value></IKCoordinateTask></objects></IKTaskSet></OpenSimDocument>"""


@dataclass(frozen=True)
class FileSample:
    """A valid file, and what reads it."""

    path: Path
    read: Callable[[Path], object]


def _json(path: Path, content: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def _text(path: Path, content: str) -> Path:
    path.write_text(content)
    return path


def documents(folder: Path) -> dict[str, FileSample]:
    """Files of text: JSON, TOML, XML and tables."""
    joints = {"left_hip": [40.0, 50.0], "head": [60.0, 20.0]}
    people = {"people": [{"pose_keypoints_2d": np.round(np.random.default_rng(1).uniform(1, 99, 78), 1).tolist()}]}
    for camera in RIG.names:
        points = _json(folder / "pose" / f"{camera}_json" / f"{camera}_000000.json", people)
    names = [f"{name}.{key}" for name in RIG.names for key in PARAMETER_NAMES]
    covariance = {
        "together": True,
        "cameras": {camera.name: {"lens": {"fx": {"value": camera.matrix[0, 0]}}} for camera in RIG},
        "covariance": {"parameters": names, "matrix": np.eye(len(names)).tolist()},
    }
    board = {"type": "ChArUco", "columns": 9, "rows": 6, "dictionary": "DICT_5X5_250", "square_m": 0.1}
    clocks = {"cameras": {RIG.names[1]: {"offset_s": 0.01, "offset_sd_s": 0.001, "drift_ppm": 3, "drift_sd_ppm": 1}}}
    named = {"marker_centres_lps_mm": [[1.0, 2, 3], [4, 5, 6]], "marker_centres_sd_mm": [[0.1] * 3] * 2}
    named |= {"marker_names": ["A", "B"], "marker_segment": ["femur", "tibia"], "marker_diameter_mm": [6.0, 6.1]}
    outline = Contour(structure="femur", axis="k", index=3, anchors=np.ones((2, 2)), outline=np.eye(4)[:, :2] * 5)
    write_contours(folder / "contours.json", [outline], GRID, "image.nii.gz")
    setup = '[segments]\nthigh = ["a", "b", "c"]\nshank = ["s*"]\n[landmarks]\nHJC = ["u", "v"]\n[joints.knee]\n'
    setup += 'parent = "thigh"\nchild = "shank"\ndegrees_of_freedom = 3\n[noise]\nmm = 0.4\n'
    wand = {"type": "wand", "distances_m": [0.2, 0.4], "ball_m": 0.04}
    parts = "cartilage,part,area_mm2,volume_mm3,mean_mm,thickest_mm,covered_percent\nfemoral,whole,10,20,2,3,90\n"
    rows = "time_s,left_knee_flexion_deg,left_knee_flexion_sd_deg,knee_x_mm\n0.0,1.5,0.2,3\n0.01,1.6,0.2,3\n"
    skin = "time_s,thigh:a_x_mm,thigh:a_y_mm,thigh:a_z_mm\n0.0,1,2,3\n0.1,1,2,3\n"
    events = "time_s,event,side,source\n0.1,foot strike,left,plate\n"
    curves = "cycle_percent,knee_deg_mean,knee_deg_between_cycles_sd\n"
    curves += "".join(f"{percent},1.5,\n" for percent in range(CYCLE_POINTS))
    steps = "cycle,side,start_s,end_s,off_s,quantity,unit,value,sd\n1,left,0.1,1.2,0.8,stride_length,m,1.3,0.01\n"
    repeated = "kind,start_s,lowest_s,end_s,depth_m,depth_sd_m,takeoff_s,landing_s,flight_sd_s,knee_largest_deg\n"
    repeated += "squat,0.5,1.2,2.0,0.4,0.01,,,,90\njump,3,3.4,4.2,0.3,0.01,3.7,4.2,0.01,80\n"
    cloud = "time,a_x_mm,a_y_mm,a_z_mm,b_x_mm,b_y_mm,b_z_mm\n"
    cloud += "".join(f"{f / 9},1,2,3,400,500,{f}\n" for f in range(9))
    picked = {"landmarks_lps_mm": {"LE": [1, 2, 3]}}
    board |= {"marker_m": 0.07}
    static = "landmark,x_mm,y_mm,z_mm,sd_mm\nleft_HJC,10.5,-20,900,5\nleft_LE,1,2,3,5\n"
    return {
        "landmarks": FileSample(_json(folder / "landmarks.json", picked), read_landmarks),
        "markers": FileSample(_json(folder / "markers.json", named), gadolinium.read_markers),
        "scanner markers": FileSample(_json(folder / "m.json", named), read_scanner_markers),
        "contours": FileSample(folder / "contours.json", read_contours),
        "covariance": FileSample(
            _json(folder / "calibration.json", covariance),
            lambda path: read_camera_covariance(path.with_suffix(".toml"), RIG),
        ),
        "board": FileSample(
            _json(folder / "board.json", board), lambda path: board_of_content(path, board_content(path))
        ),
        "target": FileSample(_json(folder / "wand.json", wand), lambda path: read_target(path, None, read_markers)),
        "settings": FileSample(
            _text(folder / "trial.toml", 'stature_m = 1.7\nframes = [1, 9]\n[videos]\ncam01 = "a.mp4"\n'),
            lambda path: read_settings(path.parent),
        ),
        "marker setup": FileSample(_text(folder / "markers.toml", setup), read_marker_setup),
        "map": FileSample(_text(folder / "map.toml", '[joints]\nleft_thigh = "thigh.L"\n'), read_map),
        "name map": FileSample(_text(folder / "names.toml", '[angles]\nknee_angle_r = "right_knee"\n'), read_name_map),
        "clicks": FileSample(
            _json(folder / "clicks.json", {"frame": 3, RIG.names[0]: joints, RIG.names[1]: joints}),
            lambda path: read_start_joints(path, RIG, frames=range(9)),
        ),
        "key points": FileSample(points, lambda path: read_key_points(path.parents[1], RIG, count=1)),
        "start key points": FileSample(points, lambda path: read_start_joints(path.parents[1], RIG, frames=range(1))),
        "clocks": FileSample(_json(folder / "sync.json", clocks), lambda path: read_clocks(path, RIG.names)),
        "tasks": FileSample(_text(folder / "tasks.xml", TASKS), read_tasks),
        "seeds": FileSample(
            _text(folder / "seeds.csv", "x,y,x,y\n10,20,30,40\n,,5,6\n"), lambda path: read_seeds(path, RIG)
        ),
        "parts": FileSample(_text(folder / "cartilage.csv", parts), read_parts),
        "joint table": FileSample(_text(folder / "joints.csv", rows), read_joint_csv),
        "marker motion": FileSample(_text(folder / "marker_motion.csv", skin), read_marker_motion),
        "static landmarks": FileSample(_text(folder / "static.csv", static), read_static_landmarks),
        "events": FileSample(_text(folder / "events.csv", events), read_event_csv),
        "cycle curves": FileSample(_text(folder / "cycles.csv", curves), read_cycle_bands),
        "gait cycles": FileSample(_text(folder / "gait_cycles.csv", steps), read_gait_cycles_csv),
        "repetitions": FileSample(_text(folder / "repetitions.csv", repeated), read_repetitions),
        "marker table": FileSample(_text(folder / "cloud.csv", cloud), read_markers),
        "matrix of text": FileSample(_text(folder / "matrix.txt", "900 0 320\n0 900 240\n0 0 1\n"), read_matrix),
    }  # fmt: skip


def archives(folder: Path) -> dict[str, FileSample]:
    """Archives of arrays."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(3)
    motion = BoneMotion(
        segments=("thigh", "shank"), rotation=rotations.exp(rng.normal(size=(6, 2, 3))),
        origin=rng.normal(size=(6, 2, 3)), covariance=np.tile(np.eye(6) * 1e-4, (6, 2, 1, 1)),
    )  # fmt: skip
    write_bones(folder / "bones.npz", BoneFile(motion=motion, time=np.arange(6) / 50, side="left"))
    write_surface(folder / "surface.npz", [some_points(rng, [0, 0, 1, 2])], ("a", "b", "c"))
    trajectories = Trajectories(
        frames=np.arange(6), rate=29.97, position=rng.normal(size=(6, 4, 3)), velocity=rng.normal(size=(6, 4, 3)),
        acceleration=rng.normal(size=(6, 4, 3)), covariance=rng.normal(size=(6, 4, 3, 3)),
        camera_names=("left", "right"), pixels=rng.normal(size=(6, 4, 2, 2)), removed=np.zeros(4, bool),
    )  # fmt: skip
    write_trajectories(folder / "trajectories.npz", trajectories)
    basis, coefficients, turns = rng.normal(size=(3, 3, 5)), rng.normal(size=(6, 3)), rng.normal(size=(6, 3))
    shape, rotation = np.einsum("fk,kip->fip", coefficients, basis), rotations.exp(turns)
    shapes = RecoveredShapes(
        kind=ONE_VIEW, shape=shape, shape_sd=0.1 * np.abs(shape), rotation=rotation, rotation_sd=np.full((6, 3), 0.01),
        translation=np.zeros((6, 2)), basis=basis, coefficients=coefficients, residuals=np.full((1, 6, 5), 0.1),
        predicted=np.zeros((6, 5), bool), modelled=(rotation @ shape)[None, :, :2], noise_sd=np.array([0.1]),
        gauge=GAUGES[ONE_VIEW], notes=("a note",),
        curve=RankCurve(ranks=np.arange(1, 4), errors=np.ones(3), errors_sd=np.full(3, np.nan), measure="error"),
    )  # fmt: skip
    write_shapes(folder / "shapes.npz", shapes, labels=list("abcde"))
    write_arrays(folder / "deforming.npz", {"tracks": rng.normal(size=(6, 2, 5)), "rate": 25.0, "edges": [[0, 1]]})
    write_arrays(folder / "points.npz", {"points": [[1.0, 2], [30, 40]], "frame": 0})
    write_arrays(folder / "matrix.npz", {"matrix": [[900.0, 0, 320], [0, 900, 240], [0, 0, 1]]})
    np.save(folder / "matrix.npy", np.array([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]]))
    write_masks(folder / "masks.npz", (rng.random((9, 13)) > 0.5 for _ in range(4)), shape=(4, 9, 13))
    segments = ("thigh", "shank")
    return {
        "bones": FileSample(folder / "bones.npz", read_bones),
        "recorded bones": FileSample(folder / "bones.npz", read_recording),
        "reference": FileSample(
            write_reference(folder / "reference.npz", [0, 2]), lambda path: read_reference(path, segments, frames=9)
        ),
        "surface": FileSample(folder / "surface.npz", read_surface),
        "trajectories": FileSample(folder / "trajectories.npz", read_trajectories),
        "shapes": FileSample(folder / "shapes.npz", read_shapes),
        "deforming points": FileSample(folder / "deforming.npz", read_deforming),
        "points": FileSample(folder / "points.npz", lambda path: read_points(path, frames=9, size=(64, 48))),
        "matrix": FileSample(folder / "matrix.npz", read_matrix),
        "matrix array": FileSample(folder / "matrix.npy", read_matrix),
        "masks": FileSample(folder / "masks.npz", lambda path: list(open_masks(path).masks())),
    }


def _segments(text: str) -> dict[str, str]:
    """Return the segment by the name of its joint in a tree of joints."""
    names, parents = rigs.tree(text)
    found = name_joints(dict(enumerate(names)), {n: p for n, p in enumerate(parents) if p >= 0}, {})
    return {names[n]: segment for segment, n in found.items()}


def motions(folder: Path) -> dict[str, FileSample]:
    """Files of a captured motion, of markers, and of characters."""
    folder.mkdir(parents=True, exist_ok=True)
    person = performer.body()
    motion = performer.motion(person).frames(slice(0, 4))
    write_results(folder / "motion", motion, person, preset="full", mass_kg=70)
    trial = write_trial(folder / "markers.c3d", {name: path[:5] for name, path in marker_points().items()}, force=True)
    text = rigs.RIGS["mixamo"]
    rigs.write_rig(folder / "rig.glb", text, _segments(text), arms="t", unit=0.01)
    own = folder / "motion"
    return {
        "motion": FileSample(own / "motion.npz", read_motion),
        "body": FileSample(own / "body.npz", read_body),
        "trc": FileSample(own / "joint_centres.trc", read_trc),
        "recorded trc": FileSample(own / "joint_centres.trc", read_recording),
        "mot": FileSample(own / "angles.mot", read_table),
        "recorded mot": FileSample(own / "angles.mot", read_recording),
        "sto": FileSample(own / "orientations.sto", read_orientations),
        "recorded sto": FileSample(own / "orientations.sto", read_recording),
        "osim": FileSample(own / "body.osim", read_osim_model),
        "character": FileSample(own / "body.glb", read_character),
        "rig": FileSample(folder / "rig.glb", read_rig),
        "c3d": FileSample(trial, read_markers),
        "c3d events": FileSample(trial, read_events),
        "c3d forces": FileSample(trial, read_force_plates),
        "recorded c3d": FileSample(own / "motion.c3d", read_recording),
    }


def scans(folder: Path) -> dict[str, FileSample]:
    """Volumes, labels and meshes."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(5)
    volume = Volume(intensity=rng.uniform(10, 200, GRID.shape).astype(np.float32), grid=GRID)
    for ending in ("nii", "nii.gz", "nrrd", "mha"):
        write_volume(folder / f"image.{ending}", volume)
    values = np.zeros(GRID.shape, np.uint8)
    values[1:4, 2:5, 2:6] = 1
    write_labels(folder / "labels", Labels(labels=values, grid=GRID))
    vertices = np.array([[0.0, 0, 0], [9, 0, 0], [0, 9, 0], [0, 0, 9]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    surface = TriangleSurface(vertices_mm=vertices, faces=faces)
    for ending in ("ply", "stl", "vtk", "glb"):
        write_mesh(folder / f"mesh.{ending}", surface)
    write_arrays(folder / "mesh.npz", {"vertices": vertices, "faces": faces})
    _text(folder / "mesh.obj", "".join(f"v {x} {y} {z}\n" for x, y, z in vertices) + "f 1 3 2\nf 1 2 4\nf 1 4 3\n")
    _text(folder / "mesh.off", "OFF\n4 1 0\n" + "".join(f"{x} {y} {z}\n" for x, y, z in vertices) + "3 0 2 1\n")
    cv2.imwrite(str(folder / "picture.png"), rng.integers(0, 255, (9, 12, 3)))
    cv2.imwrite(str(folder / "picture.jpg"), rng.integers(0, 255, (9, 12, 3)))
    found = {f"volume {e}": FileSample(folder / f"image.{e}", read_volume) for e in ("nii", "nii.gz", "nrrd", "mha")}
    meshes = ("ply", "stl", "vtk", "glb", "npz", "obj", "off")
    found |= {f"mesh {e}": FileSample(folder / f"mesh.{e}", read_mesh) for e in meshes}
    found |= {f"picture {e}": FileSample(folder / f"picture.{e}", read_picture) for e in ("png", "jpg")}
    names = next((folder / "labels").glob("*.json"))
    return found | {
        "labels": FileSample(folder / "labels" / "labels.nii.gz", read_labels),
        "label names": FileSample(names, lambda path: read_labels(path.parent / "labels.nii.gz")),
    }


GROUPS: dict[str, Callable[[Path], dict[str, FileSample]]] = {
    "documents": documents, "archives": archives, "motions": motions, "scans": scans,
}  # fmt: skip
"""The samples of all readers, by the kind of file."""


def samples(folder: Path) -> dict[str, FileSample]:
    """Write the samples of all readers."""
    return {name: sample for group, write in GROUPS.items() for name, sample in write(folder / group).items()}
