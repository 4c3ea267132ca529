"""The folder in which bad inputs are typed: small valid inputs of every command, made without recordings."""

import json
from pathlib import Path

import cv2
import numpy as np
from tests import made_steps, performer, rigs
from tests.clips import make_trial, numbered_picture, write_video
from tests.detected import JOINTS, openpose, write_folder
from tests.file_samples import TASKS
from tests.io.mr.test_volumes import write_series
from tests.made_animations import made_activity
from tests.trials import marker_points, write_reference, write_trial

from marey.io.gltf.rig_names import name_joints
from marey.io.markers.c3d import write_c3d
from marey.io.mr.contours import write_contours
from marey.io.mr.meshes import write_mesh
from marey.io.mr.volumes import write_labels, write_volume
from marey.io.opensim.mot_sto import TimeSeriesTable, write_table
from marey.io.opensim.trc import PointPaths, write_trc
from marey.io.results.gait import write_cycle_csv
from marey.io.results.results import write_results
from marey.knee.outlines.contours import Contour
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.volume import Labels, Volume, VoxelGrid
from marey.motion.events.detection import find_events
from marey.pipelines.gait.files import write_gait
from marey.pipelines.gait.walk import gait_from

CAMERAS = ("cam01", "cam02", "cam03")
"""Cameras of the trial."""
GRID = VoxelGrid(shape=(8, 12, 10), lps_from_voxel=np.diag([-0.5, 0.5, 2.0, 1.0]))
"""Grid of the made scans."""


def write_scene(folder: Path) -> None:
    """Write valid inputs of all commands."""
    for write in (_trial, _session, _markers, _shapes, _motions, _walks, _device, _scans, _activity):
        write(folder)


def _trial(folder: Path) -> None:
    trial = make_trial(folder, CAMERAS)
    (trial / "background").mkdir()
    for name in CAMERAS:
        cv2.imwrite(str(trial / "background" / f"{name}.png"), numbered_picture(0))
    rng = np.random.default_rng(0)
    people = [[openpose(rng.uniform(5, 43, (len(JOINTS), 2)))] for _ in CAMERAS]
    write_folder(folder / "pose", CAMERAS, [people] * 12)
    joints = {name: [30.0 + k, 20.0 + k] for k, name in enumerate(JOINTS[:6])}
    (folder / "clicks.json").write_text(json.dumps({"frame": 3} | {name: joints for name in CAMERAS}))
    (folder / "seeds.csv").write_text("x,y,x,y,x,y\n10,20,30,30,30,30\n,,5,6,7,8\n")
    (folder / "note.txt").write_text("a note\n")
    (folder / "empty").touch()
    (folder / "empty_folder").mkdir()


def _session(folder: Path) -> None:
    session = folder / "board"
    session.mkdir()
    for number in range(3):
        for name in CAMERAS[:2]:
            cv2.imwrite(str(session / f"{name}_{number}.png"), numbered_picture(number))
    (session / "board.json").write_text(json.dumps({"type": "chessboard", "columns": 9, "rows": 6, "square_m": 0.1}))
    (folder / "floor.json").write_text(json.dumps({"points": {"a": [0, 0, 0], "b": [1, 0, 0], "c": [0, 1, 0]}}))


def _markers(folder: Path) -> None:
    points = {name: path[:40] for name, path in marker_points().items()}
    write_trial(folder / "walk.c3d", points, force=True)
    write_trial(folder / "static.c3d", {name: path[:5] for name, path in points.items()})
    write_reference(folder / "frame0.npz")
    stacked = np.stack(list(points.values()), 1)
    write_trc(
        folder / "walk.trc", PointPaths(names=tuple(points), time=np.arange(40) / 100, rate=100.0, points=stacked)
    )
    head = ",".join(["time", *(f"{name}_{axis}_mm" for name in points for axis in "xyz")])
    rows = [",".join(f"{x:.3f}" for x in (f / 100, *(1e3 * stacked[f]).ravel())) for f in range(40)]
    (folder / "walk.csv").write_text("\n".join([head, *rows]) + "\n")
    labels = {name: [label for label in points if label.startswith(name)] for name in ("thigh", "shank")}
    setup = "[segments]\n" + "".join(f"{name} = {json.dumps(own)}\n" for name, own in labels.items())
    (folder / "person.toml").write_text(setup + '[joints.knee]\nparent = "thigh"\nchild = "shank"\n')
    (folder / "tasks.xml").write_text(TASKS)
    (folder / "study" / "S01").mkdir(parents=True)
    write_trial(folder / "study" / "S01" / "walk_1.c3d", points, force=True)
    (folder / "study" / "study.toml").write_text(
        'pattern = "{subject}/{condition}_*.c3d"\n[[steps]]\ncommand = "markers"\n'
    )


def _shapes(folder: Path) -> None:
    rng = np.random.default_rng(3)
    np.savez(folder / "cluster.npz", points=rng.normal(size=(12, 3, 7)))
    np.savez(folder / "tracks.npz", tracks=rng.normal(300, 50, size=(12, 2, 9)))
    np.savez(folder / "clicked.npz", points=rng.uniform(5, 40, size=(6, 2)), frame=0)
    for name in ("left", "right"):
        write_video(folder / f"{name}.mp4", 12)
    write_video(folder / "small.mp4", 12, size=(30, 20))
    cv2.imwrite(str(folder / "small.png"), np.full((20, 30), 255, np.uint8))
    cv2.imwrite(str(folder / "mask.png"), np.full((48, 64), 255, np.uint8))
    (folder / "matrix.txt").write_text("60 0 32\n0 60 24\n0 0 1\n")


def _motions(folder: Path) -> None:
    person = performer.body()
    write_results(folder / "motion", performer.motion(person).frames(slice(0, 6)), person, preset="full", mass_kg=70)
    (folder / "motion" / "report.html").write_text("<!doctype html>")
    names, parents = rigs.tree(rigs.MIXAMO)
    found = name_joints(dict(enumerate(names)), {n: p for n, p in enumerate(parents) if p >= 0}, {})
    rigs.write_rig(folder / "knight.glb", rigs.MIXAMO, {names[n]: segment for segment, n in found.items()}, unit=0.01)
    (folder / "joints.toml").write_text('[joints]\nleft_thigh = "mixamorig:LeftUpLeg"\n')
    (folder / "angles.toml").write_text('[angles]\nright_knee_flexion = "right_knee_flexion"\n')
    time = np.arange(0, 4, 0.02)
    knee = 35 - 30 * np.cos(5 * time) + 5 * np.sin(11 * time) + 3 * time
    for name in ("a", "b"):
        write_table(
            folder / f"{name}.mot",
            TimeSeriesTable(name=name, columns=("right_knee_flexion",), time=time, values=knee[:, None]),
        )


def _walks(folder: Path) -> None:
    """Write the results of a walk, and of two reference walks."""
    made = made_steps.made_walk()
    gait = gait_from(made, find_events(made))
    curves = np.sin(np.linspace(0, 2 * np.pi, 101))[:, None] * [20.0, 22.0]
    for name in ("walk", "norm/a", "norm/b"):
        (folder / name).mkdir(parents=True)
        write_gait(folder / name, gait, None)
        write_cycle_csv(
            folder / name / "cycles.csv", ("left_knee_flexion_deg", "right_knee_flexion_deg"), curves, np.ones((101, 2))
        )  # fmt: skip


def _device(folder: Path) -> None:
    time = np.arange(0, 6, 0.02)
    height = 0.9 + 0.1 * np.sin(3 * time) + 0.05 * np.sin(7.3 * time)
    points = np.zeros((len(time), 2, 3))
    points[:, 1, 0], points[..., 2] = 0.2, height[:, None]
    names = ("left_hip", "right_hip")
    write_trc(folder / "hips.trc", PointPaths(names=names, time=time, rate=50.0, points=points))
    rows = [f"{t:.2f},{400 + 90 * np.sin(3 * t):.2f},{400 + 90 * np.sin(7.3 * t):.2f}" for t in time]
    (folder / "forces.csv").write_text("\n".join(["time,left,right", *rows]) + "\n")
    (folder / "taps.csv").write_text("motion_s,device_s\n1,1.5\n2,2.5\n3,3.5\n")


def _scans(folder: Path) -> None:
    rng = np.random.default_rng(5)
    write_volume(
        folder / "knee.nii.gz", Volume(intensity=rng.uniform(10, 200, GRID.shape).astype(np.float32), grid=GRID)
    )
    values = np.zeros(GRID.shape, np.uint8)
    values[1:4, 2:5, 2:6] = 1
    write_labels(folder / "atlas", Labels(labels=values, grid=GRID))
    write_series(folder / "series", list(range(6)))
    corners = np.array([[0.0, 0, 0], [90, 0, 0], [0, 90, 0], [0, 0, 90]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    for name in ("bone", "other"):
        for ending in ("ply", "stl", "vtk", "glb"):
            write_mesh(folder / f"{name}.{ending}", TriangleSurface(vertices_mm=corners, faces=faces))
    (folder / "bone.obj").write_text("".join("v {} {} {}\n".format(*corner) for corner in corners) + "f 1 3 2\n")
    outline = Contour(structure="femur", axis="k", index=3, anchors=np.ones((2, 2)), outline=np.eye(4)[:, :2] * 5)
    write_contours(folder / "contours.json", [outline], GRID, "knee.nii.gz")


def _activity(folder: Path) -> None:
    made_activity(folder / "activity", frames=4, fine=2)
    points = np.random.default_rng(2).normal(size=(5, 4, 3))
    paths = PointPaths(names=tuple("abcd"), time=np.arange(5) / 50, rate=50.0, points=points)
    write_c3d(folder / "strange.c3d", paths)
    (folder / "picked.json").write_text(json.dumps({"landmarks_lps_mm": {"LE": [1, 2, 3]}}))
