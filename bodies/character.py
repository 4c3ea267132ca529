"""Make a character for retargeting: a stocky person of metaballs, in a T posture, with the joint names of common rigs.

    PYTHONPATH=src python bodies/character.py stocky.glb

Names, centimetres and posture are those of other makers, so that `marey retarget` has to work for it; only the skin is
ours. docs/how-to/retarget.md shows it.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.kinematics import blend_skin
from marey.body.articulation.surface import Body, ShapeSpace
from marey.body.metaballs.metaball_person import metaball_body, metaball_space
from marey.body.metaballs.spline_skin import spline_body
from marey.geometry import rotations
from marey.io.gltf.glb import write_glb
from marey.io.gltf.gltf import Gltf, binary_chunk, pack_glb

NAMES = {
    "pelvis": "Hips", "abdomen": "Spine", "thorax": "Spine2", "neck": "Neck", "head": "Head", "clavicle": "Shoulder",
    "upperarm": "Arm", "forearm": "ForeArm", "hand": "Hand", "thigh": "UpLeg", "shank": "Leg", "foot": "Foot",
    "toes": "ToeBase",
}  # fmt: skip
SIZES = {
    "thigh_length": -0.3, "shank_length": -0.3, "upperarm_length": 0.15, "forearm_length": 0.2, "abdomen_depth": 0.3,
    "abdomen_breadth": 0.2, "thorax_breadth": 0.2, "head_breadth": 0.2, "head_depth": 0.2, "upperarm_breadth": 0.3,
    "upperarm_depth": 0.3, "forearm_breadth": 0.4, "forearm_depth": 0.4, "shank_breadth": 0.2, "shank_depth": 0.2,
}  # fmt: skip
"""Sizes relative to the generic person's, as shape numbers of the metaballs."""
CENTIMETRE = 0.01
"""One centimetre [m]."""


def stocky() -> Body:
    """Make the body."""
    space = metaball_space("full")
    return spline_body(metaball_body(space, np.array([SIZES.get(name, 0.0) for name in space.names])))


def with_arms_out(body: Body) -> Body:
    """Return the body with a T as its rest posture."""
    skeleton, names = body.skeleton, body.skeleton.segment_names
    turns = np.tile(np.eye(3), (len(names), 1, 1))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        arm = [names.index(f"{side}_{segment}") for segment in ("upperarm", "forearm", "hand")]
        along = body.joint_centres[arm[2]] - body.joint_centres[arm[0]]
        turns[arm] = rotations.shortest(along, np.array([sign, 0.0, 0.0]))
    joints = np.array(body.joint_centres)
    for k, parent in enumerate(skeleton.parents):
        if parent >= 0:
            joints[k] = joints[parent] + turns[parent] @ (body.joint_centres[k] - body.joint_centres[parent])
    skin = blend_skin(body.vertices, body.vertex_segments, body.vertex_weights, body.joint_centres, turns, joints)
    lift = np.array([0.0, 0.0, -skin[:, 2].min()])
    return replace(body, space=_fixed(skin + lift, joints + lift), numbers=np.zeros(0), metaballs=None)


def _fixed(vertices: Floats, joints: Floats) -> ShapeSpace:
    none = np.zeros((0, 0))
    return ShapeSpace(
        names=(), vertex_mean=vertices, vertex_modes=np.zeros((0, *vertices.shape)), joint_mean=joints,
        joint_modes=np.zeros((0, *joints.shape)), prior_mean=np.zeros(0), prior_covariance=none,
    )  # fmt: skip


def foreign(path: Path) -> None:
    """Rename the joints of a GLB file, and convert them to centimetres below an armature that scales them back."""
    gltf = Gltf(path)
    document, binary = gltf.document, bytearray(gltf.buffer(0))
    skin = document["skins"][0]
    for node in (document["nodes"][n] for n in skin["joints"]):
        side, _, plain = node["name"].rpartition("_")
        node["name"] = f"mixamorig:{side.capitalize()}{NAMES[plain]}"
        node["translation"] = [x / CENTIMETRE for x in node["translation"]]
    accessor = document["accessors"][skin["inverseBindMatrices"]]
    start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
    bind = np.frombuffer(binary, "<f4", 16 * accessor["count"], start).reshape(-1, 4, 4).copy()
    bind[:, :, :3] /= CENTIMETRE
    binary[start : start + bind.nbytes] = bind.tobytes()
    root = document["scenes"][0]["nodes"]
    document["nodes"].append({"name": "Armature", "scale": [CENTIMETRE] * 3, "children": [root[0]]})
    root[0] = len(document["nodes"]) - 1
    document["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [0.25, 0.45, 0.6, 1.0]
    path.write_bytes(pack_glb(document, [binary_chunk(bytes(binary))]))


if __name__ == "__main__":
    write_glb(sys.argv[1], with_arms_out(stocky()))
    foreign(Path(sys.argv[1]))
