"""Characters of other makers, made up by the tests: names, proportions, rest postures, axes and units of their own."""

import json
import struct
from pathlib import Path

import numpy as np

from marey.geometry import rotations
from marey.io.gltf.rig import retargeted, write_rig_motion
from marey.motion.retarget import RigMotion

MIXAMO = """
mixamorig:Hips
 mixamorig:Spine
  mixamorig:Spine1
   mixamorig:Spine2
    mixamorig:Neck
     mixamorig:Head
      mixamorig:HeadTop_End
    mixamorig:{S}Shoulder
     mixamorig:{S}Arm
      mixamorig:{S}ForeArm
       mixamorig:{S}Hand
        mixamorig:{S}HandThumb1
 mixamorig:{S}UpLeg
  mixamorig:{S}Leg
   mixamorig:{S}Foot
    mixamorig:{S}ToeBase
     mixamorig:{S}Toe_End
"""
UNREAL = """
root
 pelvis
  spine_01
   spine_02
    spine_03
     clavicle_{s}
      upperarm_{s}
       lowerarm_{s}
        hand_{s}
         index_01_{s}
       upperarm_twist_01_{s}
     neck_01
      neck_02
       head
  thigh_{s}
   calf_{s}
    foot_{s}
     ball_{s}
"""
RIGIFY = """
root
 DEF-spine
  DEF-pelvis.{U}
  DEF-thigh.{U}
   DEF-thigh.{U}.001
    DEF-shin.{U}
     DEF-shin.{U}.001
      DEF-foot.{U}
       DEF-toe.{U}
  DEF-spine.001
   DEF-spine.002
    DEF-spine.003
     DEF-spine.004
      DEF-spine.005
       DEF-spine.006
     DEF-shoulder.{U}
      DEF-upper_arm.{U}
       DEF-upper_arm.{U}.001
        DEF-forearm.{U}
         DEF-hand.{U}
"""
SMPL = """
Pelvis
 {U}_Hip
  {U}_Knee
   {U}_Ankle
    {U}_Foot
 Spine1
  Spine2
   Spine3
    Neck
     Head
    {U}_Collar
     {U}_Shoulder
      {U}_Elbow
       {U}_Wrist
        {U}_Hand
"""
BIPED = """
Bip01
 Bip01 Pelvis
  Bip01 Spine
   Bip01 {U} Thigh
    Bip01 {U} Calf
     Bip01 {U} Foot
      Bip01 {U} Toe0
   Bip01 Spine1
    Bip01 Neck
     Bip01 Head
     Bip01 {U} Clavicle
      Bip01 {U} UpperArm
       Bip01 {U} Forearm
        Bip01 {U} Hand
"""
VROID = """
Root
 J_Bip_C_Hips
  J_Bip_C_Spine
   J_Bip_C_Chest
    J_Bip_C_UpperChest
     J_Bip_C_Neck
      J_Bip_C_Head
     J_Bip_{U}_Shoulder
      J_Bip_{U}_UpperArm
       J_Bip_{U}_LowerArm
        J_Bip_{U}_Hand
  J_Bip_{U}_UpperLeg
   J_Bip_{U}_LowerLeg
    J_Bip_{U}_Foot
     J_Bip_{U}_ToeBase
"""
DAZ = """
hip
 pelvis
  {s}ThighBend
   {s}ThighTwist
    {s}Shin
     {s}Foot
      {s}Metatarsals
       {s}Toe
 abdomenLower
  abdomenUpper
   chestLower
    chestUpper
     {s}Collar
      {s}ShldrBend
       {s}ForearmBend
        {s}Hand
     neckLower
      neckUpper
       head
"""
CMU = """
Hips
 {U}HipJoint
  {S}UpLeg
   {S}Leg
    {S}Foot
     {S}ToeBase
 LowerBack
  Spine
   Spine1
    Neck
     Neck1
      Head
    {S}Shoulder
     {S}Arm
      {S}ForeArm
       {S}Hand
"""
UNREAL_5 = """
root
 pelvis
  spine_01
   spine_02
    spine_03
     clavicle_{s}
      upperarm_{s}
       lowerarm_{s}
        hand_{s}
        lowerarm_twist_02_{s}
        lowerarm_twist_01_{s}
       upperarm_twist_01_{s}
       upperarm_twist_02_{s}
     neck_01
      neck_02
       head
  thigh_{s}
   calf_{s}
    foot_{s}
     ball_{s}
    calf_twist_01_{s}
   thigh_twist_01_{s}
"""
HUMAN_IK = """
Hips
 {S}UpLeg
  {S}UpLegRoll
   {S}Leg
    {S}LegRoll
     {S}Foot
      {S}ToeBase
 Spine
  Spine1
   Neck
    Head
   {S}Shoulder
    {S}Arm
     {S}ArmRoll
      {S}ForeArm
       {S}ForeArmRoll
        {S}Hand
"""
RIGIFY_SPLIT = RIGIFY.replace(
    "        DEF-forearm.{U}\n         DEF-hand.{U}",
    """        DEF-forearm.{U}
         DEF-forearm.{U}.001
          DEF-hand.{U}""",
)
ALONG = {
    "upperarm_twist_01_{s}": ("upperarm", "forearm", 0.33), "upperarm_twist_02_{s}": ("upperarm", "forearm", 0.67),
    "lowerarm_twist_01_{s}": ("forearm", "hand", 0.67), "lowerarm_twist_02_{s}": ("forearm", "hand", 0.33),
    "thigh_twist_01_{s}": ("thigh", "shank", 0.5), "calf_twist_01_{s}": ("shank", "foot", 0.5),
}  # fmt: skip
"""Where twist joints stand: from which joint to which, and how far."""
RIGS = {
    "mixamo": MIXAMO, "unreal": UNREAL, "rigify": RIGIFY, "smpl": SMPL, "biped": BIPED, "vroid": VROID, "daz": DAZ,
    "cmu": CMU, "unreal5": UNREAL_5, "human_ik": HUMAN_IK, "rigify_split": RIGIFY_SPLIT,
}  # fmt: skip


def tree(text: str) -> tuple[list[str], list[int]]:
    """Read a tree by its indentation, both sides of what has one: names and parents, -1 for the root."""
    names: list[str] = []
    parents: list[int] = []
    for side in ("left", "right"):
        stack: list[tuple[int, int]] = []
        for line in filter(str.strip, text.splitlines()):
            depth = len(line) - len(line.lstrip())
            name = line.strip().format(S=side.capitalize(), s=side[0], U=side[0].upper())
            while stack and stack[-1][0] >= depth:
                stack.pop()
            if name not in names:
                names.append(name)
                parents.append(stack[-1][1] if stack else -1)
            stack.append((depth, names.index(name)))
    return names, parents


def rest_places(arms: str) -> dict[str, np.ndarray]:
    """Give joint centres by segment [m], Y up, looking along Z; arms "t" or "a"; no proportion is the usual one."""
    out = np.array([1.0, 0, 0]) if arms == "t" else np.array([np.cos(0.7), -np.sin(0.7), 0.05])
    out = out / np.linalg.norm(out)
    shoulder = np.array([0.2, 1.3, -0.03])
    left = {
        "clavicle": [0.05, 1.28, 0], "upperarm": shoulder, "forearm": shoulder + 0.25 * out,
        "hand": shoulder + 0.46 * out, "thigh": [0.1, 0.8, 0.01], "shank": [0.12, 0.45, 0.02],
        "foot": [0.13, 0.1, -0.01], "toes": [0.16, 0.03, 0.12],
    }  # fmt: skip
    middle = {"pelvis": [0, 0.85, 0], "abdomen": [0, 0.95, -0.02], "thorax": [0, 1.2, -0.03], "neck": [0, 1.4, 0],
              "head": [0, 1.5, 0.02]}  # fmt: skip
    both = {f"left_{n}": np.array(p, float) for n, p in left.items()}
    both |= {f"right_{n}": np.array(p, float) * [-1, 1, 1] for n, p in left.items()}
    return both | {n: np.array(p, float) for n, p in middle.items()}


def write_rig(
    path: Path, text: str, segments: dict[str, str], *, arms: str = "t", unit: float = 1.0, seed: int = 1,
    size: float = 1.0, bones: bool = True, turned: bool = False,
    change: object = None,
) -> None:  # fmt: skip
    """Write a character as a GLB: an armature that stands its Z-up joints up and scales them, and a box at each joint.

    Args:
        path: The file.
        text: The tree.
        segments: By name in the tree: the segment, for those joints that are one; others lie near their parents.
        arms: The rest posture.
        unit: Metres of the armature's unit.
        seed: Of the joints' own axes.
        size: Beside the usual one.
        bones: whether joints have axes of their own.
        turned: whether the character looks backward and aside.
        change: A function that changes the document before it is written.
    """
    rng = np.random.default_rng(seed)
    names, parents = tree(text)
    places, at = rest_places(arms), np.zeros((len(names), 3))
    for n, name in enumerate(names):
        base = at[parents[n]] if parents[n] >= 0 else np.zeros(3)
        at[n] = size * places[segments[name]] if name in segments else base + [0, 0.01 * size, 0]
    for n in range(len(names) - 1, -1, -1):  # what lies between two joints of ours lies between them
        below = [k for k, p in enumerate(parents) if p == n]
        if names[n] not in segments and parents[n] >= 0 and below and names[parents[n]] in segments:
            at[n] = 0.5 * (at[parents[n]] + at[below[0]])
    for name, (start, end, share) in ALONG.items():
        for side in ("left", "right"):
            if name.format(s=side[0]) in names:
                ends = (size * places[f"{side}_{n}"] for n in (start, end))
                at[names.index(name.format(s=side[0]))] = (1 - share) * next(ends) + share * next(ends)
    if turned:
        at = at @ rotations.about(np.array([0.0, 1.0, 0]), np.array(2.2)).T
    turn = rotations.exp(rng.normal(size=(len(names), 3)) * (1.0 if bones else 0.0))
    armature = rotations.about(np.array([1.0, 0, 0]), np.array(-np.pi / 2))
    nodes: list[dict] = [{"name": "Armature", "rotation": quaternion(armature), "scale": [unit] * 3, "children": []}]
    for n, name in enumerate(names):
        p = parents[n]
        base, start = (turn[p], at[p]) if p >= 0 else (armature, np.zeros(3))
        node = {"name": name, "translation": (base.T @ (at[n] - start) / unit).tolist(),
                "rotation": quaternion(base.T @ turn[n])}  # fmt: skip
        children = [k + 1 for k, q in enumerate(parents) if q == n]
        nodes.append(node | ({"children": children} if children else {}))
        if p < 0:
            nodes[0]["children"].append(n + 1)
    nodes.append({"name": "Body", "mesh": 0, "skin": 0})
    _write(path, nodes, at, turn, unit, change)


def quaternion(rotation: np.ndarray) -> list[float]:
    w, x, y, z = rotations.to_quaternion(rotation)
    return [x, y, z, w]


def _write(path: Path, nodes: list[dict], at: np.ndarray, turn: np.ndarray, unit: float, change) -> None:
    count = len(at)
    corners = 0.03 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    positions = (at[:, None] + corners).reshape(-1, 3).astype("<f4")
    bind = np.tile(np.eye(4), (count, 1, 1))
    for n in range(count):  # scene from joint, undone
        whole = np.eye(4)
        whole[:3, :3], whole[:3, 3] = turn[n] * unit, at[n]
        bind[n] = np.linalg.inv(whole)
    joints = np.zeros((4 * count, 4), "u1")
    joints[:, 0] = np.repeat(np.arange(count), 4)
    weights = np.zeros((4 * count, 4), "<f4")
    weights[:, 0] = 1
    faces = np.concatenate([4 * n + np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]) for n in range(count)])
    parts = [positions, joints, weights, np.swapaxes(bind, 1, 2).astype("<f4"), faces.astype("<u2")]
    views, binary = [], b""
    for part in parts:
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": part.nbytes})
        binary += part.tobytes() + b"\0" * (-part.nbytes % 4)
    kinds = [(5126, 4 * count, "VEC3"), (5121, 4 * count, "VEC4"), (5126, 4 * count, "VEC4"), (5126, count, "MAT4"),
             (5123, faces.size, "SCALAR")]  # fmt: skip
    accessors = [{"bufferView": i, "componentType": c, "count": n, "type": t} for i, (c, n, t) in enumerate(kinds)]
    accessors[0] |= {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
    document = {
        "asset": {"version": "2.0", "generator": "tests"}, "scene": 0, "scenes": [{"nodes": [0, len(nodes) - 1]}],
        "nodes": nodes, "bufferViews": views, "accessors": accessors, "buffers": [{"byteLength": len(binary)}],
        "skins": [{"joints": list(range(1, count + 1)), "inverseBindMatrices": 3}],
        "meshes": [{"primitives": [
            {"attributes": {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2}, "indices": 4, "material": 0}]}],
        "materials": [{"name": "Stoff, grün", "extras": {"theirs": 1}}],
    }  # fmt: skip
    if change is not None:
        change(document)
    if path.suffix == ".gltf":
        path.with_suffix(".bin").write_bytes(binary)
        document["buffers"][0]["uri"] = path.with_suffix(".bin").name
        path.write_text(json.dumps(document), encoding="utf-8")
    else:
        path.write_bytes(glb(document, binary))


def glb(document: dict, binary: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<IIIII", 0x46546C67, 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A)
    return head + text + struct.pack("<II", len(binary), 0x004E4942) + binary


def open_glb(path: Path) -> tuple[dict, bytes]:
    """Read a GLB with nothing of ours."""
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def play(document: dict, binary: bytes, number: int = -1) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Play an animation at its keys: times (K,), and by name each node's matrix (K, 4, 4) in the scene."""

    def array(index: int) -> np.ndarray:
        accessor = document["accessors"][index]
        start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        return np.frombuffer(binary, "<f4", accessor["count"] * width, start).reshape(-1, width).astype(float)

    animation = document["animations"][number]
    tracks = {}
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        tracks[channel["target"]["node"], channel["target"]["path"]] = array(sampler["output"])
    time = array(animation["samplers"][0]["input"])[:, 0]
    parents = {c: n for n, node in enumerate(document["nodes"]) for c in node.get("children", [])}

    def world(node: int) -> np.ndarray:
        own = document["nodes"][node]
        q = tracks.get((node, "rotation"), np.tile(own.get("rotation", [0, 0, 0, 1]), (len(time), 1)))
        matrix = np.tile(np.eye(4), (len(time), 1, 1))
        if "matrix" in own:
            matrix = matrix @ np.array(own["matrix"]).reshape(4, 4).T
        else:
            matrix[:, :3, :3] = rotations.from_quaternion(q[:, [3, 0, 1, 2]]) * np.array(own.get("scale", [1, 1, 1]))
            matrix[:, :3, 3] = tracks.get((node, "translation"), own.get("translation", [0, 0, 0]))
        return world(parents[node]) @ matrix if node in parents else matrix

    return time, {node["name"]: world(n) for n, node in enumerate(document["nodes"])}


def write_retargeted(path, gltf, rig, motion, **how) -> RigMotion:
    """Transfer a motion to a character, and write the copy."""
    moved = retargeted(gltf, rig, motion, **how)
    write_rig_motion(path, gltf, rig, moved)
    return moved
