"""Results of a capture reopened with other programs, and compared with `motion.npz`.

The programs are OpenSim (opensim), ezc3d, trimesh and pygltflib, xarray, Blender (bpy), and a reader of BVH in this
module. A program that is not installed is skipped and named. A difference above the format's own rounding is an error.
"""

import argparse
from pathlib import Path

import numpy as np

from bench.common import program
from bench.declaration import Bench
from bench.recording import Column, Run

BENCH = Bench(
    measures="Largest difference between written results and what other programs read from them.",
    sources=("src/marey/io", "src/marey/motion"),
    minutes=2,
)

OPENSIM_FROM_WORLD = np.eye(3)[[1, 2, 0]]


def check_opensim(folder: Path, motion: dict) -> dict[str, float]:
    """Let OpenSim pose body.osim by angles.mot; compare with joint_centres.trc, orientations.sto and motion.npz."""
    import opensim

    opensim.Logger.removeFileSink()
    opensim.Logger.setLevelString("error")
    model = opensim.Model(str(folder / "body.osim"))
    state = model.initSystem()
    table = opensim.TimeSeriesTable(str(folder / "angles.mot"))
    if table.getTableMetaDataString("inDegrees") != "yes":
        raise SystemExit("angles.mot is not in degrees")
    paths = opensim.TimeSeriesTableVec3(str(folder / "joint_centres.trc"))
    turns = opensim.TimeSeriesTableQuaternion(str(folder / "orientations.sto"))
    labels, markers, bodies = table.getColumnLabels(), paths.getColumnLabels(), turns.getColumnLabels()
    coordinates = model.updCoordinateSet()
    if set(labels) != {coordinates.get(i).getName() for i in range(coordinates.getSize())}:
        raise SystemExit("the columns of angles.mot are not the coordinates of body.osim")
    point, turn, stated = [0.0], [0.0], [0.0]
    for f in range(table.getNumRows()):
        row = table.getRowAtIndex(f).to_numpy()
        if not np.isfinite(row).all():
            continue
        for name, value in zip(labels, row, strict=True):
            coordinate = coordinates.get(name)
            metres = coordinate.getMotionType() == opensim.Coordinate.Translational
            coordinate.setValue(state, float(value if metres else np.radians(value)), False)
        model.realizePosition(state)
        for k, name in enumerate(markers):
            seen = model.getMarkerSet().get(name).getLocationInGround(state).to_numpy()
            point.append(np.abs(seen - paths.getRowAtIndex(f).getElt(0, k).to_numpy()).max())
            there = OPENSIM_FROM_WORLD @ motion["joint_centres"][f, list(motion["joint_names"]).index(name)]
            stated.append(np.abs(seen - there).max())
        for k, name in enumerate(bodies):
            rotation = model.getBodySet().get(name).getRotationInGround(state)
            other = opensim.Rotation(turns.getRowAtIndex(f).getElt(0, k))
            turn.append(_apart(_matrix(rotation), _matrix(other)))
    if paths.getNumRows() != len(motion["time"]):
        raise SystemExit("joint_centres.trc has not a row for each frame")
    return {
        "body.osim + angles.mot against joint_centres.trc [mm]": max(point) * 1e3,
        "body.osim + angles.mot against motion.npz [mm]": max(stated) * 1e3,
        "body.osim + angles.mot against orientations.sto [degrees]": max(turn),
    }


def _matrix(rotation) -> np.ndarray:
    return np.array([[rotation.asMat33().get(i, j) for j in range(3)] for i in range(3)])


def _apart(a: np.ndarray, b: np.ndarray) -> float:
    """Angle between two rotations [degrees], exact for small ones."""
    return float(np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(a - b) / np.sqrt(8), 0, 1))))


def check_c3d(folder: Path, motion: dict) -> dict[str, float]:
    """Let ezc3d read points and rotations."""
    import ezc3d

    c3d = ezc3d.c3d(str(folder / "motion.c3d"))
    if c3d["parameters"]["POINT"]["UNITS"]["value"] != ["mm"]:
        raise SystemExit("motion.c3d is not in mm")
    points = np.moveaxis(c3d["data"]["points"][:3], 0, -1).swapaxes(0, 1) / 1e3
    residual = c3d["data"]["meta_points"]["residuals"][0].T
    if not np.array_equal(residual < 0, np.isnan(motion["joint_centres"]).any(-1)):
        raise SystemExit("motion.c3d marks other points as missing than motion.npz")
    matrices = np.transpose(c3d["data"]["rotations"], (3, 2, 0, 1))
    return {
        "motion.c3d points [mm]": _largest(points - motion["joint_centres"]) * 1e3,
        "motion.c3d ROTATION, turn [-]": _largest(matrices[..., :3, :3] - motion["segment_rotation"]),
        "motion.c3d ROTATION, origin [mm]": _largest(matrices[..., :3, 3] / 1e3 - motion["segment_origin"]) * 1e3,
    }


def _largest(difference: np.ndarray) -> float:
    return float(np.nanmax(np.abs(difference)))


def check_glb(folder: Path, motion: dict) -> dict[str, float]:
    """Let trimesh load the scene and pygltflib the skin and animation; pose it by hand as a viewer does."""
    import pygltflib
    import trimesh

    scene = trimesh.load(folder / "body.glb")
    mesh = next(iter(scene.geometry.values()))
    gltf = pygltflib.GLTF2().load(str(folder / "body.glb"))
    blob = gltf.binary_blob()

    def array(index: int) -> np.ndarray:
        accessor = gltf.accessors[index]
        view = gltf.bufferViews[accessor.bufferView]
        kind = {5126: "<f4", 5121: "u1", 5125: "<u4"}[accessor.componentType]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor.type]
        start = view.byteOffset + (accessor.byteOffset or 0)
        return np.frombuffer(blob, kind, accessor.count * width, start).reshape(accessor.count, width).astype(float)

    skin, primitive = gltf.skins[0], gltf.meshes[0].primitives[0]
    inverse_bind = array(skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
    vertices, joints = array(primitive.attributes.POSITION), array(primitive.attributes.JOINTS_0).astype(int)
    weights = array(primitive.attributes.WEIGHTS_0)
    animation = gltf.animations[0]
    times = array(animation.samplers[0].input)[:, 0]
    tracks = {(c.target.node, c.target.path): array(animation.samplers[c.sampler].output) for c in animation.channels}
    parent = {child: n for n, node in enumerate(gltf.nodes) for child in node.children or []}
    turn_back = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # Blender's importer: (x, y, z) = file (x, -z, y)
    worst_vertex, worst_origin, jump = 0.0, 0.0, 0.0
    reference = np.load(folder / "skin.npz")["vertices"] if (folder / "skin.npz").exists() else None
    for i, time in enumerate(times):
        placed: dict[int, np.ndarray] = {}
        for node in skin.joints:  # parents stand before their children
            local = np.eye(4)
            local[:3, 3] = tracks.get((node, "translation"), {i: gltf.nodes[node].translation})[i]
            local[:3, :3] = _from_xyzw(tracks[node, "rotation"][i])
            placed[node] = placed[parent[node]] @ local if parent.get(node) in placed else local
        matrices = np.stack([placed[n] for n in skin.joints])
        frame = int(np.argmin(np.abs(motion["time"] - time)))
        origins = matrices[:, :3, 3] @ turn_back.T
        worst_origin = max(worst_origin, _largest(origins - motion["segment_origin"][frame]))
        moved = np.einsum(
            "vj,vjab,vb->va", weights, (matrices @ inverse_bind)[joints], np.c_[vertices, np.ones(len(vertices))]
        )
        if reference is not None:
            worst_vertex = max(worst_vertex, _largest(moved[:, :3] @ turn_back.T - reference[frame]))
    for (_, path), values in tracks.items():
        if path == "rotation" and len(values) > 1:
            jump = max(jump, float(-np.sum(values[1:] * values[:-1], 1).min()))
    if jump > 0:
        raise SystemExit("body.glb: a quaternion jumps to its other sign")
    if len(mesh.vertices) != len(vertices):
        raise SystemExit("body.glb: trimesh sees another number of vertices")
    found = {"body.glb, segments [mm]": worst_origin * 1e3}
    return found | ({} if reference is None else {"body.glb, skin against skin.npz [mm]": worst_vertex * 1e3})


def _from_xyzw(q: np.ndarray) -> np.ndarray:
    x, y, z, w = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def check_bvh(folder: Path, motion: dict) -> dict[str, float]:
    """Pose the hierarchy as Blender's importer does: channels in the order in which they are listed."""
    words = (folder / "motion.bvh").read_text().split()
    names, parents, offsets, channels, stack = [], [], [], [], []
    i = 0
    while words[i] != "MOTION":
        word = words[i]
        if word in ("ROOT", "JOINT", "End"):
            names.append(words[i + 1])
            parents.append(stack[-1] if stack else -1)
            channels.append([])
        elif word == "{":
            stack.append(len(names) - 1)
        elif word == "}":
            stack.pop()
        elif word == "OFFSET":
            offsets.append([float(v) for v in words[i + 1 : i + 4]])
        elif word == "CHANNELS":
            channels[-1] = words[i + 2 : i + 2 + int(words[i + 1])]
        i += 1
    frames, step = int(words[i + 2]), float(words[i + 5])
    values = np.array(words[i + 6 :], float).reshape(frames, -1)
    if abs(step * float(motion["rate"]) - 1) > 1e-5 or frames != len(motion["time"]):
        raise SystemExit("motion.bvh has another rate or number of frames")
    worst = 0.0
    segment = {str(n): k for k, n in enumerate(motion["segment_names"])}
    for f in np.flatnonzero(np.isfinite(motion["segment_origin"]).all((1, 2))):
        column, placed = 0, []
        for name, parent, offset, listed in zip(names, parents, offsets, channels, strict=True):
            local = np.eye(4)
            local[:3, 3] = offset
            for channel in listed:
                axis, value = "XYZ".index(channel[0]), values[f, column]
                column += 1
                if channel.endswith("position"):
                    local[axis, 3] = value + (0 if parent < 0 else offset[axis])
                else:
                    quaternion = np.zeros(4)
                    quaternion[axis], quaternion[3] = np.sin(np.radians(value) / 2), np.cos(np.radians(value) / 2)
                    local[:3, :3] = local[:3, :3] @ _from_xyzw(quaternion)
            placed.append(local if parent < 0 else placed[parent] @ local)
            if name in segment:
                x, y, z = placed[-1][:3, 3] / 100
                worst = max(worst, _largest(np.array([x, -z, y]) - motion["segment_origin"][f, segment[name]]))
    return {"motion.bvh, segments [mm]": worst * 1e3}


def check_blender(folder: Path, motion: dict) -> dict[str, float]:
    """Let Blender's own importers read BVH (scale 0.01) and GLB; compare the bones, in Blender's axes."""
    import bpy

    folder, found = folder.resolve(), {}
    names = [str(name) for name in motion["segment_names"]]
    known = np.flatnonzero(np.isfinite(motion["segment_origin"]).all((1, 2)))[::5]
    for kind in ("motion.bvh", "body.glb"):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.context.scene.render.fps = round(float(motion["rate"]))
        if kind == "motion.bvh":
            bpy.ops.import_anim.bvh(filepath=str(folder / kind), global_scale=0.01, frame_start=1)
        else:
            bpy.ops.import_scene.gltf(filepath=str(folder / kind))
        armature = next(thing for thing in bpy.data.objects if thing.type == "ARMATURE")
        worst = 0.0
        for f in known:
            bpy.context.scene.frame_set(int(f) + (kind == "motion.bvh"))  # its first frame is 1
            posed = armature.evaluated_get(bpy.context.evaluated_depsgraph_get())
            for bone in posed.pose.bones:
                if bone.name in names:
                    there = np.array((posed.matrix_world @ bone.matrix).translation)
                    worst = max(worst, _largest(there - motion["segment_origin"][f, names.index(bone.name)]))
        found[f"{kind} in Blender, segments [mm in float32]"] = worst * 1e3
    return found


def check_netcdf(folder: Path, motion: dict) -> dict[str, float]:
    """Let xarray open motion.nc."""
    import xarray

    with xarray.open_dataset(folder / "motion.nc") as data:
        worst = 0.0
        for name, value in motion.items():
            seen = data[name].values
            if value.dtype.kind == "U":
                if list(seen) != list(value):
                    raise SystemExit(f"motion.nc: {name} differs")
            elif not np.array_equal(np.isnan(seen.astype(float)), np.isnan(value.astype(float))):
                raise SystemExit(f"motion.nc: {name} has other gaps")
            elif value.size and np.isfinite(value).any():
                worst = max(worst, _largest(seen.astype(float) - value.astype(float)))
    return {"motion.nc against motion.npz [-]": worst}


LIMITS = {"mm": 1e-3, "mm in float32": 1e-2, "degrees": 1e-3, "-": 1e-6}
CHECKS = (check_opensim, check_c3d, check_glb, check_bvh, check_netcdf, check_blender)


def check(folder: Path) -> tuple[dict[str, float], list[str]]:
    """Run every check whose program is there.

    Returns:
        The largest difference of each comparison, and the programs that are missing.
    """
    with np.load(folder / "motion.npz") as file:
        motion = {name: file[name] for name in file.files}
    found: dict[str, float] = {}
    missing = []
    for one in CHECKS:
        try:
            found |= one(folder, motion)
        except ModuleNotFoundError as error:
            missing.append(str(error.name))
    return found, missing


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("take", nargs="?", default="reach", help="a take of data/people")


def run(run: Run) -> None:
    """Capture, reopen, and compare.

    Raises:
        SystemExit: If a difference is too large.
    """
    _, results = program.take(run, run.arguments.take)
    found, missing = check(results)
    table = run.table("Written results reopened", ("quantity", "unit"), Column("largest difference"), Column("limit"))
    bad = []
    for name, value in found.items():
        what, _, unit = name.rpartition(" [")
        limit = LIMITS[unit.rstrip("]")]
        table.row((what, unit.rstrip("]")), f"{value:.1e}", f"{limit:.0e}")
        if not value <= limit:
            bad.append(what)
    if missing:
        table.note = f"Not installed and therefore skipped: {', '.join(missing)}."
    if bad:
        raise SystemExit(f"Larger than the limit: {', '.join(bad)}.")
